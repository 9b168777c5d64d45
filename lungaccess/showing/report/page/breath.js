// Breathing: where tissue and devices are in a phase, from 0 (end-exhale) to 1 (end-inhale).
import { unpack } from "./decode.js";
import { add, cross, dot, minus, times, unit } from "./vectors.js";
import { linear, placedVolume } from "./voxels.js";

const MOST_STEPS = 40;
const CONVERGED_MM = 1e-3;
const POLAR_STEPS = 12;
const AHEAD_MM = 1;
const PLACES = 65535;
// A place is moved so far into the field, so that rounding does not put it beyond.
const INSIDE_MM = 1e-6;

export class Breath {
  static async of(packed) {
    const breath = Object.assign(new Breath(), packed, { masksPhase: packed.masks_phase });
    breath.fields = await Promise.all(packed.fields.map(async (field) => [await placedVolume(field)]));
    for (const plan of breath.plans) plan.margins = await Promise.all(plan.samples.margins_mm.map(unpack));
    return breath;
  }

  // Return which share of its displacement a place of the masks is moved by.
  share(phase) {
    return this.amplitude * (phase - this.masksPhase);
  }

  // Return the displacement between end-exhale and end-inhale of a place of the masks, mm.
  displacement(place) {
    const [{ grid: { first, shape }, spacing }] = this.fields[0];
    // Beyond the field it is that at its border.
    const [x, y, z] = place.map((value, axis) =>
      Math.min(Math.max(value, first[axis] + INSIDE_MM), first[axis] + (shape[axis] - 1) * spacing - INSIDE_MM));
    return this.fields.map((field) => this.step_mm * linear(field, x, y, z));
  }

  moved(place, share) {
    return add(place, times(this.displacement(place), share));
  }

  // Return which place of the masks is at a point.
  pulledBack(point, share) {
    let place = point;
    for (let n = 0; n < MOST_STEPS; n++) {
      const next = minus(point, times(this.displacement(place), share)), step = minus(next, place);
      place = next;
      if (dot(step, step) < CONVERGED_MM ** 2) break;
    }
    return place;
  }

  // Return the displacements of the vertices of a surface as they are stored.
  displacements(places, { low_lps: low, size_mm: size }) {
    const found = new Float32Array(places.length);
    for (let n = 0; n < places.length; n += 3) {
      found.set(this.displacement([0, 1, 2].map((k) => low[k] + (places[n + k] / PLACES) * size[k])), n);
    }
    return found;
  }

  // Return functions that carry places, and turn directions, with the tip of the scope of a plan.
  rigid(number, phase) {
    const { centre_lps: centre, displacement_mm: displacement, gradient } = this.plans[number], share = this.share(phase);
    const rows = rotation(gradient.map((row, r) => row.map((value, c) => share * value + (r === c ? 1 : 0))));
    const turned = (vector) => rows.map((row) => dot(row, vector));
    return { turned, place: (at) => add(add(centre, times(displacement, share)), turned(minus(at, centre))) };
  }

  // Return the state of a deployment as it is in a phase: tubes and needle are rigid with the scope's tip, and
  // the scope goes with the airway around it.
  carried(state, number, phase) {
    const share = this.share(phase);
    if (share === 0) return state;
    const { place: rigid, turned } = this.rigid(number, phase);
    const withTissue = (place) => this.moved(place, share);
    const { eye, forward, up } = state.camera, there = withTissue(eye);
    const led = (vector) => minus(withTissue(add(eye, times(vector, AHEAD_MM))), there);
    const ahead = unit(led(forward)), above = led(up);
    const outside = state.stage > 0;
    return {
      ...state,
      scope: state.scope.map(withTissue),
      outer: state.outer.map(rigid), middle: state.middle.map(rigid), inner: state.inner.map(rigid),
      needle: state.needle.map(rigid),
      camera: { eye: there, forward: ahead, up: unit(minus(above, times(ahead, dot(above, ahead)))) },
      tip: outside ? rigid(state.tip) : withTissue(state.tip),
      direction: outside ? turned(state.direction) : ahead,
    };
  }

  // Return the number of the computed phase that is nearest, and that phase.
  sample(number, phase) {
    const { phases } = this.plans[number].samples;
    const n = Math.round(phase * (phases.length - 1));
    return { n, phase: phases[n] };
  }

  // Say which phase it is, and what the plan states of it.
  words(number, phase, accepted) {
    const { samples, window, warning_only: warning } = this.plans[number], { n, phase: known } = this.sample(number, phase);
    const inside = window && window.some(([begin, end]) => begin <= phase && phase <= end);
    const good = !accepted ? "✗ stated, but the check refuses the plan" : warning ? "? by a model only" : "✓ proved";
    const verdict = inside === null ? "not computed" : inside ? good : "✗ not proved";
    return `${(100 * phase).toFixed(0)} % of the breath: ${verdict}; at ${(100 * known).toFixed(0)} % ends ${samples.target_mm[n].toFixed(1)} mm from the target`;
  }
}

// Return the rows of the rotation nearest to a matrix of three rows (Newton's iteration for its polar factor).
function rotation(matrix) {
  let rows = matrix;
  for (let n = 0; n < POLAR_STEPS; n++) {
    const [a, b, c] = rows, inverse = [cross(b, c), cross(c, a), cross(a, b)], size = dot(a, inverse[0]);
    rows = rows.map((row, r) => times(add(row, times(inverse[r], 1 / size)), 0.5));
  }
  return rows;
}
