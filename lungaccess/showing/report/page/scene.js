// The 3-D scene: see-through surfaces in layers, sorted by depth in each pixel, and solid bodies and points among them.
import { unpack } from "./decode.js";
import { Layers } from "./layers.js";
import { FAINTEST, pick, project } from "./picking.js";
import { MOST_SLICES, programs } from "./shaders.js";
import { coarser, facesFrom, nearnessOf, normalsOf } from "./surfaces.js";
import { dot, eyeFromLps, minus, perspective, rgb } from "./vectors.js";

export const VIEW_HALF_ANGLE = (15 * Math.PI) / 180;
const RIM = 0.55, FAINT_GAIN = 1.5, DARK_GAIN = 2.3, DARK_FAINT_GAIN = 2.8, HAZE = 0.6, FAR_DENSE = 0.55, NEAR_DENSE = 1.5;
const INSIDE = "inside";
const NO_CUT = [0, 0, 0, 0];
// The light at the tip of the scope falls off with the distance, as on the wall.
const LAMP_PER_MM2 = 1 / 520;
const OUTLINE_PX = 1.2;
const LEAST_POINT_PX = 3;
const SLACK_MM = 20;
const MOST_PIXELS = 2_600_000;
const SLOW_MS = 30;
// Pixels of the canvas for one of the page; on a slow machine fewer, at rest and still fewer while something moves.
const FINE = 2, RESTING = 1, COARSE = 0.6;

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    // The picture is kept after it was shown, so that the page can be printed.
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!this.gl) throw new Error("WebGL 2 is not available");
    Object.assign(this, { programs: programs(this.gl), layers: new Layers(this.gl) });
    Object.assign(this, { surfaces: new Map(), solids: new Map(), points: new Map(), low: [0, 0, 0], high: [0, 0, 0] });
    Object.assign(this, { share: 0, cut: null, focus: null, focused: true, changes: 0 });
    // "moving", "rest" or "fine": how well a slow machine draws; a fast one always draws as well as it can.
    Object.assign(this, { quality: "rest", slow: null });
  }

  // Add a packed surface, which moves with the breath if there is one; resolves when it can be drawn.
  async addSurface(packed, breath = null) {
    const [places, differences] = await Promise.all([unpack(packed.vertices), unpack(packed.faces)]);
    const faces = facesFrom(differences);
    const { gl } = this;
    const attributes = [
      [places, gl.UNSIGNED_SHORT, true, 3, 0], [normalsOf(places, faces, packed.size_mm), gl.BYTE, true, 3, 4],
      ...(breath ? [[breath.displacements(places, packed), gl.FLOAT, false, 3, 0]] : []),
    ];
    this.removeSurface(packed.key);
    const surface = {
      ...uploaded(gl, attributes, faces),
      name: packed.name,
      colour: rgb(packed.colour),
      opacity: packed.opacity,
      low: packed.low_lps,
      size: packed.size_mm,
      shown: packed.shown,
      ofMasks: packed.key.startsWith("start-"),
      places,
      faces,
    };
    this.surfaces.set(packed.key, surface);
    this.enclose([...packed.low_lps, ...packed.low_lps.map((low, axis) => low + packed.size_mm[axis])]);
    this.focusOn(surface);
    this.changes += 1;
  }

  removeSurface(key) {
    this.remove(this.surfaces, key);
    this.changes += 1;
  }

  // Put solid bodies under a name, or take them away with null.
  setSolids(name, solids) {
    const { gl } = this;
    this.remove(this.solids, name);
    if (!solids || !solids.faces.length) return;
    const attributes = [solids.places, solids.normals, solids.colours].map((values) =>
      [new Float32Array(values), gl.FLOAT, false, 3, 0]);
    this.solids.set(name, uploaded(gl, attributes, new Uint32Array(solids.faces)));
    if (name !== INSIDE) this.enclose(solids.places);
  }

  // Put coloured points under a name, or take them away with null: places `3 N` in LPS mm, colours `3 N` from 0 to 1,
  // and radii in mm, one for all or `N`.  None is drawn smaller than a few pixels.
  setPoints(name, points) {
    const { gl } = this;
    this.remove(this.points, name);
    if (!points || !points.places.length) return;
    const places = Float32Array.from(points.places), count = places.length / 3;
    const radii = typeof points.radii === "number" ? new Float32Array(count).fill(points.radii) : Float32Array.from(points.radii);
    const attributes = [
      [places, gl.FLOAT, false, 3, 0], [radii, gl.FLOAT, false, 1, 0],
      [Uint8Array.from(points.colours, (value) => Math.round(255 * value)), gl.UNSIGNED_BYTE, true, 3, 0],
    ];
    this.points.set(name, { ...uploaded(gl, attributes), count, places, radii });
    this.enclose(places);
  }

  remove(map, name) {
    const old = map.get(name);
    if (!old) return;
    old.buffers.forEach((buffer) => this.gl.deleteBuffer(buffer));
    this.gl.deleteVertexArray(old.array);
    map.delete(name);
  }

  // Cut away what is before a plane through a point, `normal` pointing to what is kept; null: nothing.
  setCut(plane) {
    this.cut = plane && [...plane.normal, -dot(plane.normal, plane.point)];
  }

  // Bring out what is near a line of points, and let the rest step back; null: all alike.
  setFocus(points) {
    this.focus = points && points.length > 1 ? points : null;
    for (const surface of this.surfaces.values()) this.focusOn(surface);
    this.changes += 1;
  }

  focusOn(surface) {
    const { gl } = this;
    gl.bindVertexArray(surface.array);
    if (surface.nearness) gl.deleteBuffer(surface.nearness);
    surface.nearness = null;
    if (this.focus) surface.nearness = attribute(gl, 3, nearnessOf(surface, this.focus), gl.UNSIGNED_BYTE, true, 1, 0);
    else gl.disableVertexAttribArray(3);
    gl.bindVertexArray(null);
  }

  // Let the depth reach over flat points, a little more than needed, so that it seldom changes.
  enclose(flat) {
    const isEmpty = this.low.every((each, axis) => each === this.high[axis]);
    for (let axis = 0; axis < 3; axis++) {
      let low = Infinity, high = -Infinity;
      for (let n = axis; n < flat.length; n += 3) [low, high] = [Math.min(low, flat[n]), Math.max(high, flat[n])];
      if (isEmpty || low < this.low[axis]) this.low[axis] = low - SLACK_MM;
      if (isEmpty || high > this.high[axis]) this.high[axis] = high + SLACK_MM;
    }
  }

  // Whether to draw coarsely: while something moves on a slow machine, and on one of which nothing is known yet.
  get isHurried() {
    return this.slow === null || (this.slow && this.quality === "moving");
  }

  // Bring the canvas to its size on the page, as fine as the quality says.
  fit() {
    const { clientWidth, clientHeight } = this.canvas;
    this.fitted = [clientWidth, clientHeight];
    const wished = this.isHurried ? COARSE : this.slow && this.quality === "rest" ? RESTING : FINE;
    const scale = Math.min(wished, Math.sqrt(MOST_PIXELS / Math.max(clientWidth * clientHeight, 1)));
    const [width, height] = this.fitted.map((px) => Math.max(Math.round(px * scale), 1));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
  }

  // Draw everything that is shown, as the camera sees it.
  draw(camera, background) {
    this.paint(camera, background);
    if (this.slow !== null || !this.surfaces.size) return;
    // The second, coarse picture is timed: then the machine has its programs.
    this.finish();
    const start = performance.now();
    this.changes += 1;
    this.paint(camera, background);
    this.finish();
    this.slow = performance.now() - start > SLOW_MS;
    this.fit();
    this.paint(camera, background);
  }

  // Wait until all is drawn.
  finish() {
    this.layers.pixels(0, 0, 1, 1);
  }

  paint(camera, background) {
    const gl = this.gl;
    const { width, height } = this.canvas;
    const view = this.view = this.viewOf(camera, width / height);
    // What is proved in the phase of the masks alone is shown in that phase alone.
    // By their keys, so that the order in which they were added does not matter where two are equally deep.
    const shown = [...this.surfaces].filter(([, s]) => s.shown && !(s.ofMasks && this.share !== 0))
      .sort(([a], [b]) => (a < b ? -1 : 1)).slice(0, MOST_SLICES);
    const isFaint = ([, surface]) => surface.opacity < FAINTEST;
    view.shown = [...shown.filter((each) => !isFaint(each)), ...shown.filter(isFaint)];
    // Of what is faint, as lungs and fissures, the nearest layer says all.
    view.counts = [shown.length, this.isHurried ? 0 : shown.filter((each) => !isFaint(each)).length];
    const isNew = this.layers.fit(width, height, view.shown.length);
    gl.disable(gl.BLEND);
    gl.disable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    this.layers.into(this.layers.solids);
    this.drawSolids(view);
    this.drawPoints(view);
    const signature = JSON.stringify([
      camera.eye, camera.forward, camera.up, view.span, view.shown.map(([key]) => key), view.counts, this.share, this.cut, this.changes,
    ]);
    if (isNew || signature !== this.peeledAs) this.peel(view);
    this.peeledAs = signature;
    this.putTogether(view, background, width / Math.max(this.canvas.clientWidth, 1));
  }

  // Return the matrices of a camera and the range of depth that the scene takes.
  viewOf(camera, aspect) {
    const box = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => [0, 1, 2].map((axis) => (n & (1 << axis) ? this.high : this.low)[axis]));
    const deep = box.map((corner) => dot(minus(corner, camera.eye), camera.forward));
    const far = Math.max(...deep, 10), near = Math.max(Math.min(...deep), far / 1000, 0.5);
    return {
      camera, span: [near, far], eyeFromLps: eyeFromLps(camera.eye, camera.forward, camera.up),
      clipFromEye: perspective(VIEW_HALF_ANGLE, aspect, near, far),
    };
  }

  // Draw the layers of each structure by itself, so that nothing depends on the order of triangles or structures.
  peel(view) {
    const gl = this.gl, program = this.programs.layer;
    program({ ...view, cut: this.cut || NO_CUT, before: 0 });
    gl.activeTexture(gl.TEXTURE0);
    view.counts.forEach((count, k) => {
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.layers.arrays[k === 0 ? 1 : k - 1]);
      view.shown.slice(0, count).forEach(([, surface], n) => {
        this.layers.into(this.layers.peeled[k][n]);
        // Of a closed surface only the outside, unless a cut lets one see into it.
        if (this.cut) gl.disable(gl.CULL_FACE);
        else gl.enable(gl.CULL_FACE);
        program({ peeled: k, slice: n });
        this.drawSurface(surface, program, this.isHurried);
      });
    });
    gl.disable(gl.CULL_FACE);
  }

  putTogether(view, background, scale) {
    const gl = this.gl;
    const dark = Math.max(...background) < 0.3;
    // On a dark ground a surface has to be denser to be seen as well, and what is faint most of all;
    // that does not step back before what is near the focus.
    const isFocused = this.focus && this.focused;
    const gain = (opacity) => (opacity < FAINTEST
      ? (dark ? DARK_FAINT_GAIN : FAINT_GAIN) / (isFocused ? FAR_DENSE : 1) : dark ? DARK_GAIN : 1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.DEPTH_TEST);
    const pictures = [
      [gl.TEXTURE_2D_ARRAY, this.layers.arrays[0]], [gl.TEXTURE_2D_ARRAY, this.layers.arrays[1]],
      [gl.TEXTURE_2D, this.layers.colour], [gl.TEXTURE_2D, this.layers.known],
    ];
    const bind = () => pictures.forEach(([kind, texture], n) => {
      gl.activeTexture(gl.TEXTURE0 + n);
      gl.bindTexture(kind, texture);
    });
    bind();
    const looks = new Float32Array(4 * MOST_SLICES);
    view.shown.forEach(([, { colour, opacity }], n) => looks.set([...colour, gain(opacity) * opacity], 4 * n));
    // Haze begins a little before what is looked at, and grows evenly.
    const { distance } = view.camera, deep = 0.36 * distance + 48, step = (view.span[1] - view.span[0]) / 65534;
    this.programs.together(...view.counts)({
      first: 0, second: 1, solids: 2, known: 3, looks, background, step_mm: step,
      dense: isFocused ? [FAR_DENSE, NEAR_DENSE - FAR_DENSE, RIM] : [1, 0, RIM],
      ink: dark ? [0, 0, 0] : [0.1, 0.12, 0.14],
      outline: Math.max(Math.round(OUTLINE_PX * scale), 1),
      haze: [(HAZE * step) / deep, (HAZE * (view.span[0] - distance + deep / 6)) / deep, HAZE],
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    // A texture that is drawn into must not be bound to be read.
    for (const picture of pictures) picture[1] = null;
    bind();
  }

  // Draw the airway from inside into a square of the canvas, and copy it to another one.
  drawInside(pose, devices, target) {
    const gl = this.gl;
    const side = Math.min(this.canvas.width, this.canvas.height, 2 * target.width);
    const surface = this.surfaces.get("airway");
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, side, side);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, 0, side, side);
    gl.clearColor(0.02, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const view = {
      eyeFromLps: eyeFromLps(pose.eye, pose.forward, pose.up), clipFromEye: perspective(pose.halfAngle, 1, 0.2, 400), span: [0.2, 400],
    };
    if (surface) {
      this.programs.inside(view);
      this.drawSurface(surface, this.programs.inside);
    }
    this.setSolids(INSIDE, devices);
    this.drawSolids(view, INSIDE);
    this.setSolids(INSIDE, null);
    gl.disable(gl.SCISSOR_TEST);
    const pen = target.getContext("2d");
    pen.drawImage(this.canvas, 0, this.canvas.height - side, side, side, 0, 0, target.width, target.height);
  }

  // Draw all solid bodies, or only those of one name; each has its number among them, from 0.
  drawSolids(view, only) {
    const gl = this.gl, program = this.programs.solid;
    program({ ...view, lamp: only ? LAMP_PER_MM2 : 0 });
    [...this.solids].forEach(([name, solid], n) => {
      if (only && name !== only) return;
      program({ number: n / 255 });
      gl.bindVertexArray(solid.array);
      gl.drawElements(gl.TRIANGLES, solid.count, gl.UNSIGNED_INT, 0);
    });
  }

  // Draw the points, which are numbered after the solid bodies.
  drawPoints(view) {
    const gl = this.gl, program = this.programs.points, { width, clientWidth } = this.canvas;
    program({ ...view, pixels: [(view.clipFromEye[0] * width) / 2, (LEAST_POINT_PX * width) / Math.max(clientWidth, 1)] });
    [...this.points.values()].forEach((points, n) => {
      program({ number: (this.solids.size + n) / 255 });
      gl.bindVertexArray(points.array);
      gl.drawArrays(gl.POINTS, 0, points.count);
    });
  }

  drawSurface(surface, program, isCoarse = false) {
    const gl = this.gl;
    program({ low: surface.low, size: surface.size, share: this.share });
    gl.bindVertexArray(surface.array);
    if (isCoarse) surface.coarse ??= this.coarseOf(surface);
    const drawn = isCoarse ? surface.coarse : surface;
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, drawn.corners);
    gl.drawElements(gl.TRIANGLES, drawn.count, gl.UNSIGNED_INT, 0);
  }

  // Return fewer triangles of a surface, for when it is drawn in a hurry.
  coarseOf({ places, faces, size, buffers }) {
    const few = coarser(places, faces, size), corners = buffered(this.gl, this.gl.ELEMENT_ARRAY_BUFFER, few);
    buffers.push(corners);
    return { corners, count: few.length };
  }
}

Object.assign(Scene.prototype, { pick, project });

// Return a vertex array of attributes and, if there are any, of faces, with its buffers.
function uploaded(gl, attributes, faces = []) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  const buffers = attributes.map((each, n) => attribute(gl, n, ...each)), corners = faces.length ? buffered(gl, gl.ELEMENT_ARRAY_BUFFER, faces) : null;
  gl.bindVertexArray(null);
  return { array, buffers: [...buffers, corners], corners, count: faces.length };
}

function attribute(gl, place, values, type, normalised, size, stride) {
  const buffer = buffered(gl, gl.ARRAY_BUFFER, values);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, size, type, normalised, stride, 0);
  return buffer;
}

// Return a buffer of values, which is bound; one of faces then belongs to the vertex array that is bound.
function buffered(gl, kind, values) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(kind, buffer);
  gl.bufferData(kind, values, gl.STATIC_DRAW);
  return buffer;
}

// Return how far the camera has to be from the middle of a ball to see it whole.
export const distanceToSee = (radius) => radius / Math.sin(VIEW_HALF_ANGLE);
