// The 3-D scene: see-through surfaces, each as one layer, and solid bodies among them.
import { unpack } from "./decode.js";
import { programs } from "./shaders.js";
import { eyeFromLps, perspective, rgb } from "./vectors.js";

const VIEW_HALF_ANGLE = (15 * Math.PI) / 180;
const SCOPE_HALF_ANGLE = (48 * Math.PI) / 180;
const RIM = 0.55;
const DARK_GAIN = 1.3;
const INSIDE = "inside";

export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!this.gl) throw new Error("WebGL 2 is not available");
    this.programs = programs(this.gl);
    this.surfaces = new Map();
    this.solids = new Map();
    this.gain = 1;
    this.share = 0;
  }

  // Add a packed surface, which moves with the breath if there is one; resolves when it can be drawn.
  async addSurface(packed, breath = null) {
    const [places, differences] = await Promise.all([unpack(packed.vertices), unpack(packed.faces)]);
    const faces = facesFrom(differences);
    const gl = this.gl;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    attribute(gl, 0, places, gl.UNSIGNED_SHORT, true, 3, 0);
    attribute(gl, 1, normalsOf(places, faces, packed.size_mm), gl.BYTE, true, 3, 4);
    if (breath) attribute(gl, 2, breath.displacements(places, packed), gl.FLOAT, false, 3, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.surfaces.set(packed.key, {
      array,
      count: faces.length,
      colour: rgb(packed.colour),
      opacity: packed.opacity,
      low: packed.low_lps,
      size: packed.size_mm,
      shown: packed.shown,
      ofMasks: packed.key.startsWith("start-"),
    });
  }

  // Put solid bodies under a name, or take them away with null.
  setSolids(name, solids) {
    const gl = this.gl;
    const old = this.solids.get(name);
    if (old) {
      old.buffers.forEach((buffer) => gl.deleteBuffer(buffer));
      gl.deleteVertexArray(old.array);
      this.solids.delete(name);
    }
    if (!solids || !solids.faces.length) return;
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    const buffers = [solids.places, solids.normals, solids.colours].map((values, n) =>
      attribute(gl, n, new Float32Array(values), gl.FLOAT, false, 3, 0));
    buffers.push(gl.createBuffer());
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(solids.faces), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    this.solids.set(name, { array, buffers, count: solids.faces.length });
  }

  fit() {
    const scale = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(Math.round(this.canvas.clientWidth * scale), 1);
    const height = Math.max(Math.round(this.canvas.clientHeight * scale), 1);
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
  }

  // Draw everything that is shown, as the camera sees it.
  draw(camera, background) {
    const gl = this.gl;
    const { width, height } = this.canvas;
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.CULL_FACE);
    // On a dark ground a surface has to be denser to be seen as well.
    this.gain = Math.max(...background) < 0.3 ? DARK_GAIN : 1;
    const eye = eyeFromLps(camera.eye, camera.forward, camera.up);
    const far = camera.distance + 600;
    const clip = perspective(VIEW_HALF_ANGLE, width / height, Math.max(far / 400, 1), far);
    gl.disable(gl.BLEND);
    this.drawSolids(clip, eye);
    for (const key of [...this.surfaces.keys()].reverse()) this.drawLayer(this.surfaces.get(key), clip, eye);
  }

  // One layer: of each surface only what is nearest, so that nothing depends on the order of its triangles.
  drawLayer(surface, clip, eye) {
    // What is proved in the phase of the masks alone is shown in that phase alone.
    if (!surface.shown || (surface.ofMasks && this.share !== 0)) return;
    const gl = this.gl;
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.colorMask(false, false, false, false);
    gl.disable(gl.BLEND);
    this.drawSolids(clip, eye);
    this.use(this.programs.surface, clip, eye);
    this.drawSurface(surface, this.programs.surface);
    gl.colorMask(true, true, true, true);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthFunc(gl.LEQUAL);
    gl.depthMask(false);
    this.drawSurface(surface, this.programs.surface);
    gl.depthMask(true);
    gl.depthFunc(gl.LESS);
  }

  // Draw the airway from inside into a square of the canvas, and copy it to another one.
  drawInside(pose, devices, target) {
    const gl = this.gl;
    const side = Math.min(this.canvas.width, this.canvas.height, target.width);
    const surface = this.surfaces.get("airway");
    gl.viewport(0, 0, side, side);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, 0, side, side);
    gl.clearColor(0.02, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const eye = eyeFromLps(pose.eye, pose.forward, pose.up);
    const clip = perspective(SCOPE_HALF_ANGLE, 1, 0.2, 400);
    if (surface) {
      this.use(this.programs.inside, clip, eye);
      this.drawSurface(surface, this.programs.inside);
    }
    this.setSolids(INSIDE, devices);
    this.drawSolids(clip, eye, INSIDE);
    this.setSolids(INSIDE, null);
    gl.disable(gl.SCISSOR_TEST);
    const pen = target.getContext("2d");
    pen.drawImage(this.canvas, 0, this.canvas.height - side, side, side, 0, 0, target.width, target.height);
  }

  // Draw all solid bodies, or only those of one name.
  drawSolids(clip, eye, only) {
    this.use(this.programs.solid, clip, eye);
    for (const [name, solid] of this.solids) {
      if (only && name !== only) continue;
      this.gl.bindVertexArray(solid.array);
      this.gl.drawElements(this.gl.TRIANGLES, solid.count, this.gl.UNSIGNED_INT, 0);
    }
  }

  use(program, clip, eye) {
    this.gl.useProgram(program.program);
    this.gl.uniformMatrix4fv(program.places.clipFromEye, false, clip);
    this.gl.uniformMatrix4fv(program.places.eyeFromLps, false, eye);
  }

  drawSurface(surface, { places }) {
    const gl = this.gl;
    gl.uniform3fv(places.low, surface.low);
    gl.uniform3fv(places.size, surface.size);
    gl.uniform1f(places.share, this.share);
    gl.uniform3fv(places.colour, surface.colour);
    const opacity = Math.min(this.gain * surface.opacity, 1);
    gl.uniform1f(places.opacity, opacity);
    gl.uniform1f(places.rim, RIM * Math.min(1, 2 * opacity));
    gl.bindVertexArray(surface.array);
    gl.drawElements(gl.TRIANGLES, surface.count, gl.UNSIGNED_INT, 0);
  }
}

function attribute(gl, place, values, type, normalised, size, stride) {
  const buffer = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, size, type, normalised, stride, 0);
  return buffer;
}

// Undo lungaccess.report.html.meshes: three rows of differences become the corners of triangles.
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
function normalsOf(places, faces, size) {
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
