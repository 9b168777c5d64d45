// The devices of plans in the 3-D view and in the slices.
import { DEVICE_COLOURS, planStyle } from "./colours.js";
import { banded, Solids } from "./solids.js";
import { rgb } from "./vectors.js";

// The parts of a state of a motion, and the switch that shows each.
const PARTS = { scope: "scope", outer: "tubes", middle: "tubes", inner: "tubes", needle: "needle" };
const ALL = { scope: true, tubes: true, needle: true };
const WHITE = [1, 1, 1];
const LEAST_WIDTH = 0.0016, TARGET_MM = 1.6;

// Return the line of tubes and needle in a state.
export const lineOf = ({ outer, middle, inner, needle }) => [...outer, ...middle, ...inner, ...needle];

// Return radii that can be seen from a distance.
function thickened(radius, distance) {
  return Object.fromEntries(Object.entries(radius).map(([key, mm]) => [key, Math.max(mm, LEAST_WIDTH * distance)]));
}

function put(scene, name, isShown, fill) {
  const solids = new Solids();
  if (isShown) fill(solids);
  scene.setSolids(name, solids);
}

// Put the devices of a plan at a state into the scene, as far as they are shown; without a state, take them away.
export function showDevices(scene, plan, state, distance, shown = ALL) {
  const radius = state && thickened(plan.radius_mm, distance);
  for (const [name, kind] of Object.entries(PARTS)) {
    put(scene, name, state && shown[kind], (solids) =>
      solids.tube(state[name], radius[name], name === "needle" ? state.needleColours : rgb(DEVICE_COLOURS[name])));
  }
}

// Put the end of another plan into the scene, in the colour and the bands of its number, or take it away without an end.
export function showOther(scene, name, number, plan, end, distance, shown = ALL) {
  put(scene, name, end, (solids) => {
    const radius = thickened(plan.radius_mm, distance), { colour, bands } = planStyle(number);
    const parts = [
      ["scope", end.scope, 0.6 * radius.scope], ["tubes", lineOf({ ...end, needle: [] }), 0.8 * radius.inner],
      ["needle", end.needle, 0.8 * radius.needle],
    ];
    for (const [kind, points, mm] of parts.filter(([each]) => shown[each])) {
      const line = banded(points, rgb(colour), WHITE, bands);
      solids.tube(line.points, mm, line.colours);
    }
  });
}

// Put a ball of a colour into the scene, or take it away without a point.
export function showBall(scene, name, point, radius = TARGET_MM) {
  put(scene, name, point, (solids) => solids.ball(point, radius, rgb(DEVICE_COLOURS[name])));
}

// Return the devices as lines of a slice.
export function deviceLines({ radius_mm: radius }, state, shown = ALL) {
  return Object.entries(PARTS).filter(([name, kind]) => shown[kind] && state[name].length > 1)
    .map(([name]) => ({ points: state[name], radius: radius[name], colour: DEVICE_COLOURS[name] }));
}

// Return tubes and needle of another plan at its end as lines of a slice.
export function otherLines({ radius_mm: radius }, end, number) {
  const { colour } = planStyle(number);
  return [
    { points: lineOf({ ...end, needle: [] }), radius: radius.inner, colour },
    { points: end.needle, radius: radius.needle, colour },
  ].filter(({ points }) => points.length > 1);
}
