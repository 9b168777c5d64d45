// What the camera at the tip of the scope sees: the airway's surface from inside, and the devices ahead.
import { Solids } from "./solids.js";
import { add, rgb, times } from "./vectors.js";

const COLOURS = { outer: "#E69F00", inner: "#F4C95D" };
const ROOM_MM = 0.35;

export class Bronchoscopy {
  constructor(scene, canvas, caption) {
    this.scene = scene;
    this.canvas = canvas;
    this.caption = caption;
  }

  // Draw the view at a state of a motion.  The camera is beside the channel, within the scope.
  draw(state, motion) {
    const radius = motion.plan.radius_mm;
    const aside = Math.min(Math.max(0.7 * radius.scope, radius.outer + ROOM_MM), 0.9 * radius.scope);
    const pose = { ...state.camera, eye: add(state.camera.eye, times(state.camera.up, aside)) };
    const solids = new Solids();
    for (const key of ["outer", "inner"]) solids.tube(state[key], radius[key], rgb(COLOURS[key]));
    solids.tube(state.needle, radius.needle, state.needleColours);
    this.scene.drawInside(pose, solids, this.canvas);
    const place = state.scopeMm - (motion.ends.scope - motion.plan.scope.from_carina_mm);
    const where = place < 0 ? `${(-place).toFixed(0)} mm above the carina` : `${place.toFixed(0)} mm beyond the carina`;
    this.caption.textContent = `Scope's tip ${where}`;
  }
}
