// The devices of plans in the 3-D view and in the slices.
import { DEVICE_COLOURS, planStyle } from "../report/colours.js";
import { banded, Solids } from "../report/solids.js";
import { rgb } from "../report/vectors.js";

const TUBES = ["scope", "outer", "middle", "inner"];
const WHITE = [1, 1, 1];
const LEAST_WIDTH = 0.0016, TARGET_MM = 1.6;
export const COMPARED = "compared ";

// Return radii that can be seen from a distance.
function thickened(radius, distance) {
  return Object.fromEntries(Object.entries(radius).map(([key, mm]) => [key, Math.max(mm, LEAST_WIDTH * distance)]));
}

function put(scene, name, fill) {
  const solids = new Solids();
  if (fill) fill(solids);
  scene.setSolids(name, solids);
}

// Put the devices of a motion at a state into the scene, or take them away with null.
export function showDevices(scene, motion, state, distance) {
  const radius = motion && thickened(motion.plan.radius_mm, distance);
  for (const name of TUBES) put(scene, name, motion && ((solids) => solids.tube(state[name], radius[name], rgb(DEVICE_COLOURS[name]))));
  put(scene, "needle", motion && ((solids) => solids.tube(state.needle, radius.needle, state.needleColours)));
}

// Put the whole of other plans into the scene, each in the colour and the bands of its number; most is the largest one.
export function showCompared(scene, compared, most, distance) {
  for (let n = 1; n <= most; n++) {
    const found = compared.find(({ number }) => number === n);
    put(scene, `${COMPARED}${n}`, found && ((solids) => {
      const end = found.motion.end, radius = thickened(found.motion.plan.radius_mm, distance), { colour, bands } = planStyle(n);
      const show = (points, mm) => {
        const line = banded(points, rgb(colour), WHITE, bands);
        solids.tube(line.points, mm, line.colours);
      };
      show(end.scope, 0.6 * radius.scope);
      show([...end.outer, ...end.middle, ...end.inner], 0.8 * radius.inner);
      show(end.needle, 0.8 * radius.needle);
    }));
  }
}

export function showTarget(scene, point) {
  put(scene, "target", point && ((solids) => solids.ball(point, TARGET_MM, rgb(DEVICE_COLOURS.target))));
}

// Return the devices as lines of a slice.
export function deviceLines(motion, state) {
  const { radius_mm: radius } = motion.plan;
  return [...TUBES, "needle"].map((name) => ({ points: state[name], radius: radius[name], colour: DEVICE_COLOURS[name] }))
    .filter(({ points }) => points.length > 1);
}

export function comparedLines(compared) {
  return compared.flatMap(({ motion, number }) => {
    const end = motion.end, { radius_mm: radius } = motion.plan, { colour } = planStyle(number);
    return [
      { points: [...end.outer, ...end.middle, ...end.inner], radius: radius.inner, colour },
      { points: end.needle, radius: radius.needle, colour },
    ].filter(({ points }) => points.length > 1);
  });
}
