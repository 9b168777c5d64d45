// A plan in motion: what is where at a position of the slider.
import { DEVICE_COLOURS } from "./colours.js";
import { unpackAll } from "./decode.js";
import { minus, mix, point, rgb, unit } from "./vectors.js";

export const STAGES = ["scope", "both tubes", "inner tube", "needle"];
const WEIGHTS = [0.36, 0.14, 0.18, 0.32];

// Clearance to spare along the needle: dark where there is none, pale where there are WIDE_MM and more.
const TIGHT = rgb(DEVICE_COLOURS.needle), WIDE = rgb(DEVICE_COLOURS.needle_with_room);
export const WIDE_MM = 5;

export function marginColour(margin) {
  return mix(TIGHT, WIDE, Math.min(Math.max(margin / WIDE_MM, 0), 1));
}

export class Motion {
  static async of(packed) {
    const motion = new Motion(), { scope, tubes, needle } = packed;
    Object.assign(motion, { plan: packed }, await unpackAll({
      route: scope.points, routeMm: scope.arc_length_mm, forward: scope.forward, up: scope.up, insertedMm: scope.inserted_mm,
      sections: scope.sections, shaft: scope.shaft, shaftMm: scope.shaft_mm, tubes: tubes.points, innerMm: tubes.inner_mm,
      outerMm: tubes.outer_mm, middleMm: tubes.middle_mm, needle: needle.points, needleMm: needle.arc_length_mm, margin: needle.margin_mm,
    }));
    motion.tubePoints = tubes.points.shape[1];
    motion.sectionPoints = scope.sections.shape[1];
    const [scopeMm, outer, inner, needleMm] = ["insertedMm", "outerMm", "innerMm", "needleMm"].map((name) => motion[name].at(-1));
    motion.ends = { scope: scopeMm, outer, inner, needle: needleMm };
    motion.starts = stageStarts(motion.ends);
    return motion;
  }

  // Everything at the end of the slider.
  get end() {
    return (this.ended ??= this.at(1));
  }

  get hasNeedle() {
    return this.ends.needle > 0;
  }

  // Return everything at a place of the slider, 0 to 1; the needle is coloured by what it has to spare.
  at(position, margin = this.margin) {
    const { starts, ends } = this;
    const share = STAGES.map((_, n) => clamp((position - starts[n]) / Math.max(starts[n + 1] - starts[n], 1e-9)));
    let stage = STAGES.length - 1;
    while (stage > 0 && (share[stage] <= 0 || starts[stage] === starts[stage + 1])) stage -= 1;
    const moved = this.routeMm[this.routeMm.length - 1] * share[0];
    // How much of the scope is in, with its bending section.
    const scopeMm = between(this.insertedMm, this.routeMm, moved);
    const flush = ends.outer * (starts[1] === starts[2] ? 1 : share[1]);
    const innerMm = share[2] > 0 ? ends.outer + (ends.inner - ends.outer) * share[2] : flush;
    const needleMm = ends.needle * share[3];
    const state = { position, stage, moved, scopeMm, outerMm: Math.min(flush, ends.outer), innerMm, needleMm };
    const shaft = cut(this.shaft, this.shaftMm, scopeMm - this.insertedMm[0]);
    state.scope = [...shaft, ...row(this.sections, this.routeMm, moved, this.sectionPoints)];
    const [eye, forward, up] = [this.route, this.forward, this.up].map((array) => row(array, this.routeMm, moved)[0]);
    state.camera = { eye, forward: unit(forward), up: unit(up) };
    [state.outer, state.middle, state.inner] = share[0] < 1 ? [[], [], []] : this.tube(innerMm);
    state.needle = needleMm > 0 ? cut(this.needle, this.needleMm, needleMm) : [];
    state.needleColours = state.needle.map((_, n) => marginColour(margin[Math.min(n, margin.length - 1)]));
    const line = [state.needle, state.inner, state.middle, state.outer].find((points) => points.length > 1);
    state.tip = (line || state.scope).at(-1);
    state.direction = line ? unit(minus(line.at(-1), line.at(-2))) : state.camera.forward;
    return state;
  }

  // Return the points of the outer tube, and of what the middle and the inner one reach beyond it.
  tube(innerMm) {
    const count = this.tubePoints, points = row(this.tubes, this.innerMm, innerMm, count);
    const ends = [this.outerMm, this.middleMm].map((mm) => between(mm, this.innerMm, innerMm));
    const [outer, middle] = ends.map((mm) => {
      const at = innerMm > 0 ? (mm / innerMm) * (count - 1) : 0, whole = Math.min(Math.floor(at), count - 1);
      return { whole, border: mix(points[whole], points[Math.min(whole + 1, count - 1)], at - whole) };
    });
    return [
      [...points.slice(0, outer.whole + 1), outer.border],
      ends[0] < ends[1] ? [outer.border, ...points.slice(outer.whole + 1, middle.whole + 1), middle.border] : [],
      ends[1] < innerMm ? [middle.border, ...points.slice(middle.whole + 1)] : [],
    ];
  }

  // Say in words where the deployment is.
  words(state) {
    const mm = (value, end) => `${value.toFixed(1)} of ${end.toFixed(1)} mm`;
    const { ends } = this, [all, within] = this.plan.tubes.three ? ["All", "Inner and middle"] : ["Both", "Inner"];
    return [
      `Scope: ${mm(state.scopeMm, ends.scope)}`, `${all} tubes: ${mm(state.outerMm, ends.outer)}`,
      `${within} tube: ${mm(state.innerMm, ends.inner)}`, `Needle: ${mm(state.needleMm, ends.needle)}`,
    ][state.stage];
  }

  // Return the distance from the scope's tip along tubes and needle, as the charts count it.
  alongMm(state) {
    return state.needleMm > 0 ? this.ends.inner + state.needleMm : state.innerMm;
  }
}

// Return where each stage begins on the slider, and 1; a stage without length has no part of it.
function stageStarts(ends) {
  const lengths = [ends.scope, ends.outer, ends.inner - ends.outer, ends.needle];
  const weights = WEIGHTS.map((weight, n) => (lengths[n] > 1e-6 ? weight : 0)), sum = (few) => few.reduce((a, b) => a + b, 0);
  return [...STAGES.map((_, n) => sum(weights.slice(0, n)) / sum(weights)), 1];
}

const clamp = (value) => Math.min(Math.max(value, 0), 1);

// Return the index before a length and the share of the step to the next one.
function place(along, mm) {
  let n = 0;
  while (n + 2 < along.length && along[n + 1] <= mm) n += 1;
  return [n, clamp((mm - along[n]) / Math.max(along[n + 1] - along[n], 1e-9))];
}

// Return the value at a length, between those that are stored.
function between(values, along, mm) {
  const [n, share] = place(along, mm);
  return values[n] + share * (values[Math.min(n + 1, along.length - 1)] - values[n]);
}

// Return the points at a length, between rows of so many that are stored.
function row(points, along, mm, count = 1) {
  const [n, share] = place(along, mm), next = Math.min(n + 1, along.length - 1);
  return Array.from({ length: count }, (_, k) => mix(point(points, n * count + k), point(points, next * count + k), share));
}

function cut(points, along, mm) {
  const kept = Array.from({ length: place(along, mm)[0] + 1 }, (_, k) => point(points, k));
  return [...kept, ...row(points, along, mm)];
}
