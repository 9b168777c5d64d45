// The devices of plans in the 3-D view and in the slices.
import { Solids } from "../report/solids.js";
import { rgb } from "../report/vectors.js";

export const SCOPE = "#0072B2", OUTER = "#E69F00", MIDDLE = "#EDB42E", INNER = "#F4C95D", TARGET = "#39E0B0";
// Of compared plans: apart for every colour vision.
export const COMPARED = ["#CC79A7", "#56B4E9", "#D55E00", "#009E73", "#8C6BB1"];
const LEAST_WIDTH = 0.0016, TARGET_MM = 1.6;

// Return radii that can be seen from a distance.
function thickened(radius, distance) {
  return Object.fromEntries(Object.entries(radius).map(([key, mm]) => [key, Math.max(mm, LEAST_WIDTH * distance)]));
}

// Put the devices of a motion at a state into the scene, or take them away with null.
export function showDevices(scene, motion, state, distance) {
  const radius = motion && thickened(motion.plan.radius_mm, distance);
  const put = (name, fill) => {
    const solids = new Solids();
    if (motion) fill(solids);
    scene.setSolids(name, solids);
  };
  put("scope", (s) => s.tube(state.scope, radius.scope, rgb(SCOPE)));
  put("outer", (s) => s.tube(state.outer, radius.outer, rgb(OUTER)));
  put("middle", (s) => s.tube(state.middle, radius.middle, rgb(MIDDLE)));
  put("inner", (s) => s.tube(state.inner, radius.inner, rgb(INNER)));
  put("needle", (s) => s.tube(state.needle, radius.needle, state.needleColours));
}

// Put the whole of other plans into the scene, each in one colour.
export function showCompared(scene, compared, distance) {
  const solids = new Solids();
  for (const { motion, colour } of compared) {
    const end = motion.at(1), radius = thickened(motion.plan.radius_mm, distance);
    solids.tube(end.scope.slice(-12), 0.7 * radius.scope, rgb(colour));
    solids.tube([...end.outer, ...end.middle, ...end.inner], radius.inner, rgb(colour));
    solids.tube(end.needle, radius.needle, rgb(colour));
  }
  scene.setSolids("compared", solids);
}

export function showTarget(scene, point) {
  const solids = new Solids();
  if (point) solids.ball(point, TARGET_MM, rgb(TARGET));
  scene.setSolids("target", solids);
}

// Return the devices as lines of a slice.
export function deviceLines(motion, state) {
  const { radius_mm: radius } = motion.plan;
  return [
    { points: state.scope, radius: radius.scope, colour: "#3FA9E8" }, { points: state.outer, radius: radius.outer, colour: OUTER },
    { points: state.middle, radius: radius.middle, colour: MIDDLE }, { points: state.inner, radius: radius.inner, colour: INNER },
    { points: state.needle, radius: radius.needle, colour: "#FF4081" },
  ].filter(({ points }) => points.length > 1);
}

export function comparedLines(compared) {
  return compared.flatMap(({ motion, colour }) => {
    const end = motion.at(1), { radius_mm: radius } = motion.plan;
    return [
      { points: [...end.outer, ...end.middle, ...end.inner], radius: radius.inner, colour },
      { points: end.needle, radius: radius.needle, colour },
    ].filter(({ points }) => points.length > 1);
  });
}
