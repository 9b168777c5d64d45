// Packed surfaces: their triangles, their normals, and which of their places are near a line.
import { dot, minus, times } from "./vectors.js";

// Every so-manieth triangle is looked at for the mean edge; a cell is so many edges wide.
const SAMPLED = 97, CELL_EDGES = 2.5;
// Within WHOLLY_MM of the line a place counts wholly, beyond NOT_MM not at all.
const WHOLLY_MM = 5, NOT_MM = 15;

// Undo lungaccess.showing.report.html.meshes: three rows of differences become the corners of triangles.
export function facesFrom(differences) {
  const count = differences.length / 3;
  const faces = new Uint32Array(differences.length);
  let first = 0;
  for (let n = 0; n < count; n++) {
    first += differences[n];
    faces[3 * n] = first;
    faces[3 * n + 1] = first + differences[count + n];
    faces[3 * n + 2] = first + differences[2 * count + n];
  }
  return faces;
}

// Return a normal of four signed bytes for each vertex: the mean of its triangles by their area.
export function normalsOf(places, faces, size) {
  const [sx, sy, sz] = size;
  const sums = new Float32Array(places.length);
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f], b = 3 * faces[f + 1], c = 3 * faces[f + 2];
    const ux = (places[b] - places[a]) * sx, uy = (places[b + 1] - places[a + 1]) * sy;
    const uz = (places[b + 2] - places[a + 2]) * sz, vx = (places[c] - places[a]) * sx;
    const vy = (places[c + 1] - places[a + 1]) * sy, vz = (places[c + 2] - places[a + 2]) * sz;
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    for (const n of [a, b, c]) {
      sums[n] += x;
      sums[n + 1] += y;
      sums[n + 2] += z;
    }
  }
  const normals = new Int8Array((places.length / 3) * 4);
  for (let n = 0; n < places.length / 3; n++) {
    const length = Math.hypot(sums[3 * n], sums[3 * n + 1], sums[3 * n + 2]) || 1;
    for (let axis = 0; axis < 3; axis++) normals[4 * n + axis] = Math.round((127 * sums[3 * n + axis]) / length);
  }
  return normals;
}

// Return triangles between fewer of the same vertices: in cells of a few edges one stands for all, and what shrinks to a
// line is left out.
export function coarser(places, faces, size) {
  let sum = 0, count = 0;
  for (let f = 0; f < faces.length; f += 3 * SAMPLED, count++) {
    const [a, b] = [3 * faces[f], 3 * faces[f + 1]];
    sum += Math.hypot(...[0, 1, 2].map((axis) => ((places[a + axis] - places[b + axis]) * size[axis]) / 65535));
  }
  const steps = size.map((mm) => (mm * Math.max(count, 1)) / (65535 * CELL_EDGES * Math.max(sum, 1e-9)));
  const [ni, nj] = steps.map((step) => Math.floor(65535 * step) + 1);
  const first = new Map(), chosen = new Uint32Array(places.length / 3);
  for (let n = 0; n < chosen.length; n++) {
    const [i, j, k] = [0, 1, 2].map((axis) => Math.floor(places[3 * n + axis] * steps[axis]));
    const cell = i + ni * (j + nj * k);
    if (!first.has(cell)) first.set(cell, n);
    chosen[n] = first.get(cell);
  }
  const kept = new Uint32Array(faces.length);
  let end = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const a = chosen[faces[f]], b = chosen[faces[f + 1]], c = chosen[faces[f + 2]];
    if (a === b || b === c || c === a) continue;
    kept.set([a, b, c], end);
    end += 3;
  }
  return kept.slice(0, end);
}

// Return for each vertex how near it is to a line of points, 0 to 255.
export function nearnessOf({ places, low, size }, line) {
  const found = new Uint8Array(places.length / 3), axes = [0, 1, 2];
  const ends = axes.map((axis) => line.map((point) => point[axis]));
  const bounds = ends.map((values) => [Math.min(...values) - NOT_MM, Math.max(...values) + NOT_MM]);
  for (let n = 0; n < found.length; n++) {
    const at = (axis) => low[axis] + (places[3 * n + axis] / 65535) * size[axis];
    if (axes.some((axis) => at(axis) < bounds[axis][0] || at(axis) > bounds[axis][1])) continue;
    const share = (NOT_MM - alongLine(line, axes.map(at)).awayMm) / (NOT_MM - WHOLLY_MM);
    found[n] = Math.round(255 * Math.min(Math.max(share, 0), 1));
  }
  return found;
}

// Return how far a point is from a line of points, where on it the nearest place is and how far along, both in mm, and the
// direction of the line there.
export function alongLine(line, point) {
  let found = { awayMm: Infinity, alongMm: 0 }, before = 0;
  for (let n = 0; n + 1 < line.length; n++) {
    const step = minus(line[n + 1], line[n]), from = minus(point, line[n]), length = Math.sqrt(dot(step, step));
    if (length < 1e-6) continue;
    const share = Math.min(Math.max(dot(from, step) / (length * length), 0), 1), rest = minus(from, times(step, share));
    const awayMm = Math.sqrt(dot(rest, rest));
    if (awayMm < found.awayMm) {
      found = { awayMm, alongMm: before + share * length, place: minus(point, rest), direction: times(step, 1 / length) };
    }
    before += length;
  }
  return found;
}
