// What the camera at the tip of the scope sees: the airway's surface from inside, the devices ahead, and which way to go.
import { DEVICE_COLOURS } from "./colours.js";
import { inscribe } from "./slices.js";
import { banded, Solids } from "./solids.js";
import { add, cross, dot, minus, norm, rgb, times } from "./vectors.js";

// Openings are named from so far on, and where they are not too near to the border of the round picture.
const NAMED_MM = 45, NAMED_SHARE = 0.92;
// Rings on the tubes, and their length: by them one sees a tube and how it bends, though it ends beyond a wall.
const RINGS_MM = [0.8, 0.2], RING_SHADE = 0.25, ROUND_SIDES = 48;
const TAKEN = "#7DF0B5", OTHER_WAY = "#F2F2F2";

export class Bronchoscopy {
  // caption, prompt: elements for the words on the scope's tip, and on the bifurcation ahead.
  constructor(scene, canvas, caption, prompt) {
    Object.assign(this, { scene, canvas, caption, prompt });
  }

  // Draw the view at a state of a motion, by the camera that the plan's instructions are told for.
  draw(state, motion) {
    const radius = motion.plan.radius_mm, { camera_aside_mm: aside, half_angle_rad: halfAngle } = motion.plan.scope;
    const pose = { ...state.camera, eye: add(state.camera.eye, times(state.camera.up, aside)), halfAngle };
    const solids = new Solids(ROUND_SIDES);
    for (const key of ["outer", "middle", "inner"]) {
      const colour = rgb(DEVICE_COLOURS[key]), line = banded(state[key], colour, times(colour, RING_SHADE), RINGS_MM);
      solids.tube(line.points, radius[key], line.colours);
    }
    solids.tube(state.needle, radius.needle, state.needleColours);
    this.scene.drawInside(pose, solids, this.canvas);
    const place = state.scopeMm - (motion.ends.scope - motion.plan.scope.from_carina_mm);
    const where = place < 0 ? `${(-place).toFixed(0)} mm above the carina` : `${place.toFixed(0)} mm beyond the carina`;
    this.caption.textContent = `Scope's tip ${where}`;
    const ahead = state.stage === 0 ? bifurcationsAhead(motion, state) : [];
    this.named = ahead.flatMap(({ openings }) => openings).filter((opening) => this.name(opening, pose));
    const words = ahead.map((each) => (each.moved_mm > state.moved ? `Ahead: ${each.text}` : each.text)).join(" ");
    if (this.prompt.textContent !== words) this.prompt.textContent = words;
  }

  // Write the name of an opening onto it, and return whether it is in the picture.
  name({ place_lps: place, label, taken, in_view: inView }, { eye, forward, up, halfAngle }) {
    const away = minus(place, eye), depth = dot(away, forward), tangent = depth * Math.tan(halfAngle);
    const [x, y] = [dot(away, cross(forward, up)) / tangent, dot(away, up) / tangent];
    if (!inView || depth <= 0 || norm(away) > NAMED_MM || Math.hypot(x, y) > NAMED_SHARE) return false;
    const pen = this.canvas.getContext("2d"), half = this.canvas.width / 2, at = [half * (1 + x), half * (1 - y)];
    pen.strokeStyle = pen.fillStyle = taken ? TAKEN : OTHER_WAY;
    pen.lineWidth = taken ? 5 : 2;
    pen.beginPath();
    pen.arc(...at, 13, 0, 2 * Math.PI);
    pen.stroke();
    const words = `${taken ? "→ " : ""}${label}`, font = taken ? "bold 19px" : "19px";
    pen.font = `${font} system-ui, sans-serif`;
    const { width } = pen.measureText(words);
    const [low, high] = [half - Math.sqrt(half ** 2 - (at[1] - half) ** 2), half + Math.sqrt(half ** 2 - (at[1] - half) ** 2)];
    const below = at[1] + (at[1] > 1.6 * half ? -26 : 26), left = Math.min(Math.max(at[0] - width / 2, low + 12), Math.max(high - width - 12, low + 12));
    inscribe(pen, words, left, below, "left", font, pen.fillStyle);
    return true;
  }
}

// Return on which place of the slider, in thousandths, the scope stands before each bifurcation of its route.
export function pausesOf(motion) {
  const whole = motion.routeMm[motion.routeMm.length - 1];
  return motion.plan.scope.bifurcations.map(({ moved_mm: mm }) => Math.ceil((1000 * motion.starts[1] * mm) / whole - 1e-6));
}

// Return the bifurcations before which a state stands, or else the next one.
export function bifurcationsAhead(motion, { moved, position }) {
  const all = motion.plan.scope.bifurcations, ticks = pausesOf(motion), tick = Math.round(1000 * position);
  const here = all.filter((each, n) => ticks[n] === tick || (each.moved_mm <= moved && moved < each.entered_mm));
  return here.length ? here : all.filter((each) => each.moved_mm > moved).slice(0, 1);
}
