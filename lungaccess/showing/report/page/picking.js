// What is under a pixel: read from the layers of the last picture, so that it is what is seen.
import { add, dot, minus, point, times } from "./vectors.js";

// Surfaces less dense, as lungs and fissures, are picked only where nothing else is hit.
export const FAINTEST = 0.2;
const STEEPEST = 8;

// These are methods of Scene.  Return the first hit along the ray through a pixel of the page, from the upper left of the
// canvas, that can be picked, null for none:
//   { kind: "surface", "solid" or "points", key, point: LPS mm, depth_mm, index: of a point, hits }
// By rule: the nearest of solid bodies, points and surfaces of the structures that can be picked (opacity 0.2 and more,
// or those listed in `pickable`); if there is none, the nearest surface of all.  `hits` are all of them, nearest first.
export function pick(x, y, { pickable = null } = {}) {
  const { view, layers, canvas: { clientWidth, clientHeight } } = this;
  if (!view || !layers.width) return null;
  if (x < 0 || y < 0 || x >= clientWidth || y >= clientHeight) return null;
  const across = (x * layers.width) / clientWidth, up = layers.height - (y * layers.height) / clientHeight;
  const hits = hitsAt(this, across, up, rayThrough(this, (2 * across) / layers.width - 1, (2 * up) / layers.height - 1));
  if (!hits.length) return null;
  const can = ({ kind, key }) => kind !== "surface"
    || (pickable ? pickable.includes(key) : this.surfaces.get(key).opacity >= FAINTEST);
  return { ...(hits.find(can) || hits[0]), hits };
}

function hitsAt(scene, across, up, ray) {
  const { view, layers } = scene;
  const hits = [], step = (view.span[1] - view.span[0]) / 65534;
  // Four pixels are of one surface if it is not steeper than so.
  const most = (STEEPEST * 2 * view.camera.distance) / (view.clipFromEye[5] * layers.height * step);
  const put = (kind, key, depth) => {
    const mm = view.span[0] + depth * step;
    hits.push({ kind, key, depth_mm: mm, point: add(view.camera.eye, times(ray, mm)) });
  };
  const { number, depth: solid } = layers.read(layers.reading, across, up, most);
  if (solid < 65535) {
    const names = [...scene.solids.keys()], key = [...names, ...scene.points.keys()][number];
    put(number < names.length ? "solid" : "points", key, solid);
    if (number >= names.length) hits[0].index = nearestPoint(scene.points.get(key), hits[0].point);
  }
  view.counts.forEach((count, k) => view.shown.slice(0, count).forEach(([key], n) => {
    const { depth } = layers.read(layers.peeled[k][n], across, up, most);
    if (depth < 65535 && depth < solid) put("surface", key, depth);
  }));
  return hits.sort((a, b) => a.depth_mm - b.depth_mm);
}

// Return the direction through a place of the picture, -1 to 1, so long that it advances 1 mm along the view.
export function rayThrough({ view: { camera, clipFromEye: clip, eyeFromLps: eye } }, across, up) {
  const right = [eye[0], eye[4], eye[8]], above = [eye[1], eye[5], eye[9]];
  return add(camera.forward, add(times(right, across / clip[0]), times(above, up / clip[5])));
}

function nearestPoint({ places }, to) {
  let least = Infinity, found = -1;
  for (let n = 0; n < places.length / 3; n++) {
    const away = minus(point(places, n), to), square = dot(away, away);
    if (square < least) [least, found] = [square, n];
  }
  return found;
}

// Return where a point is in the picture, in pixels of the page from its upper left; null behind the camera and before
// the first picture.
export function project(point) {
  const { canvas, view } = this;
  if (!view) return null;
  const { eyeFromLps: eye, clipFromEye: clip } = view;
  const at = (row) => eye[row] * point[0] + eye[4 + row] * point[1] + eye[8 + row] * point[2] + eye[12 + row];
  const z = -at(2);
  if (z <= 0) return null;
  return [(0.5 + (0.5 * clip[0] * at(0)) / z) * canvas.clientWidth, (0.5 - (0.5 * clip[5] * at(1)) / z) * canvas.clientHeight];
}
