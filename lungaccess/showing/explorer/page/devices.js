// The devices of plans in the 3-D view and in the slices.
import { DEVICE_COLOURS, planStyle } from "../report/colours.js";
import { banded, Solids } from "../report/solids.js";
import { rgb } from "../report/vectors.js";

const { scope: SCOPE, outer: OUTER, middle: MIDDLE, inner: INNER, needle: NEEDLE, target: TARGET } = DEVICE_COLOURS;
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
  const show = (name, fill) => put(scene, name, motion && fill);
  show("scope", (s) => s.tube(state.scope, radius.scope, rgb(SCOPE)));
  show("outer", (s) => s.tube(state.outer, radius.outer, rgb(OUTER)));
  show("middle", (s) => s.tube(state.middle, radius.middle, rgb(MIDDLE)));
  show("inner", (s) => s.tube(state.inner, radius.inner, rgb(INNER)));
  show("needle", (s) => s.tube(state.needle, radius.needle, state.needleColours));
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
  put(scene, "target", point && ((solids) => solids.ball(point, TARGET_MM, rgb(TARGET))));
}

// Return the devices as lines of a slice.
export function deviceLines(motion, state) {
  const { radius_mm: radius } = motion.plan;
  return [
    { points: state.scope, radius: radius.scope, colour: SCOPE }, { points: state.outer, radius: radius.outer, colour: OUTER },
    { points: state.middle, radius: radius.middle, colour: MIDDLE }, { points: state.inner, radius: radius.inner, colour: INNER },
    { points: state.needle, radius: radius.needle, colour: NEEDLE },
  ].filter(({ points }) => points.length > 1);
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
