// Planes through the image: standard ones by radiological convention, and any other.
import { unpackVolume } from "./decode.js";
import { add, cross, dot, letters, minus, rgb, times, unit } from "./vectors.js";

const INK = { label: "#F2F2F2", cross: "#FFFFFF" };
const STRUCTURE_COLOURS = {
  outside: "#6B6B6B", lung: "#242424", "airway wall": "#6FA8CC", lumen: "#0E3A57", vessel: "#C4717A",
  fissure: "#8F6FB8", nodule: "#009E73",
};
const TINTED = ["airway wall", "vessel", "fissure", "nodule"];
const TINT = 0.45;
const NEAR_MM = 2;
const FAINT = 0.5;
const LATTICE_PIXELS = 8;
const NOWHERE = [0, 0, 0];

export const WINDOWS = { lung: [-1350, 150], tissue: [-160, 240] };
export const STANDARD = {
  axial: { right: [1, 0, 0], up: [0, -1, 0] },
  coronal: { right: [1, 0, 0], up: [0, 0, 1] },
  sagittal: { right: [0, 1, 0], up: [0, 0, 1] },
};

// Return the plane across a direction, seen along it, with the head (or else the front) up.
export function planeAcross(direction) {
  const start = Math.abs(direction[2]) < 0.9 ? [0, 0, 1] : [0, -1, 0];
  const up = unit(minus(start, times(direction, dot(start, direction))));
  return { right: cross(direction, up), up };
}

// The voxels of a page: structures, a CT if there is one, and a further layer painted over them.
export class VoxelImage {
  static async of(data) {
    const image = new VoxelImage();
    const load = (packed) => Promise.all((packed || []).map(unpackVolume));
    [image.labels, image.ct] = await Promise.all([load(data.labels), load(data.ct)]);
    image.table = new Uint8Array(3 * 256);
    image.tinted = new Uint8Array(256);
    for (const [name, code] of Object.entries(data.codes)) {
      image.table.set(rgb(STRUCTURE_COLOURS[name]).map((value) => 255 * value), 3 * code);
      image.tinted[code] = TINTED.includes(name) ? 1 : 0;
    }
    image.hounsfield = data.hounsfield;
    image.overlay = null;
    image.breath = null;
    image.share = 0;
    image.tint = true;
    image.setWindow("lung");
    return image;
  }

  get hasCt() {
    return this.ct.length > 0;
  }

  setWindow(name) {
    const [low, high] = WINDOWS[name];
    this.greys = new Uint8ClampedArray(256);
    if (!this.hasCt) return;
    const { lowest, per_step: step } = this.hounsfield;
    for (let n = 0; n < 256; n++) this.greys[n] = (255 * (lowest + step * n - low)) / (high - low);
  }

  // Write the colour of the image at a point to out[at...at + 2].
  paint(x, y, z, out, at) {
    const code = this.hasCt && !this.tint && !this.overlay ? 0 : nearest(this.labels, x, y, z);
    let red = this.table[3 * code], green = this.table[3 * code + 1], blue = this.table[3 * code + 2];
    if (this.hasCt) {
      const grey = this.greys[linear(this.ct, x, y, z)];
      const share = this.tint && this.tinted[code] ? TINT : 0;
      red = grey + share * (red - grey);
      green = grey + share * (green - grey);
      blue = grey + share * (blue - grey);
    }
    const over = this.overlay && !this.tinted[code] ? this.overlay(x, y, z) : null;
    out[at] = over ? over[0] : red;
    out[at + 1] = over ? over[1] : green;
    out[at + 2] = over ? over[2] : blue;
    out[at + 3] = 255;
  }
}

// Return the value of the voxel that holds a point, of the last volume that does; 0 beyond all.
export function nearest(volumes, x, y, z) {
  for (let n = volumes.length - 1; n >= 0; n--) {
    const v = volumes[n];
    const i = Math.round((x - v.first[0]) / v.spacing);
    const j = Math.round((y - v.first[1]) / v.spacing);
    const k = Math.round((z - v.first[2]) / v.spacing);
    if (i >= 0 && j >= 0 && k >= 0 && i < v.width && j < v.height && k < v.depth) {
      return v.voxels[(k * v.height + j) * v.width + i];
    }
  }
  return 0;
}

function linear(volumes, x, y, z) {
  for (let n = volumes.length - 1; n >= 0; n--) {
    const v = volumes[n];
    const fx = (x - v.first[0]) / v.spacing, fy = (y - v.first[1]) / v.spacing, fz = (z - v.first[2]) / v.spacing;
    const i = Math.floor(fx), j = Math.floor(fy), k = Math.floor(fz);
    if (i < 0 || j < 0 || k < 0 || i + 1 >= v.width || j + 1 >= v.height || k + 1 >= v.depth) continue;
    const u = fx - i, t = fy - j, s = fz - k;
    const at = (k * v.height + j) * v.width + i, row = v.width, slice = v.width * v.height, a = v.voxels;
    const lower = (1 - t) * ((1 - u) * a[at] + u * a[at + 1]) + t * ((1 - u) * a[at + row] + u * a[at + row + 1]);
    const up = at + slice;
    const upper = (1 - t) * ((1 - u) * a[up] + u * a[up + 1]) + t * ((1 - u) * a[up + row] + u * a[up + row + 1]);
    return Math.round((1 - s) * lower + s * upper);
  }
  return 0;
}

// One plane on a canvas, with the devices, the target and the patient's sides at its edges.
export class Slice {
  constructor(canvas, image) {
    this.canvas = canvas;
    this.image = image;
    this.pen = canvas.getContext("2d");
  }

  // Draw the plane { right, up } through a centre, so many mm wide.
  // marks: { lines: [{ points, radius, colour }], target, targetRadius, cross: [x, y, z] }
  draw(plane, centre, widthMm, marks) {
    const { width, height } = this.canvas;
    this.plane = { ...plane, centre, scale: width / widthMm };
    const pixels = this.pen.createImageData(width, height);
    const step = widthMm / width;
    const across = times(plane.right, step);
    const shifts = this.shifts(width, height, step);
    for (let row = 0; row < height; row++) {
      let [x, y, z] = this.pixelCentre(0, row, step);
      for (let column = 0, at = 4 * row * width; column < width; column++, at += 4) {
        const [sx, sy, sz] = shifts ? shifts(column, row) : NOWHERE;
        this.image.paint(x + sx, y + sy, z + sz, pixels.data, at);
        x += across[0];
        y += across[1];
        z += across[2];
      }
    }
    this.pen.putImageData(pixels, 0, 0);
    for (const line of marks.lines || []) this.line(line);
    if (marks.target) this.target(marks.target);
    if (marks.cross) this.cross(marks.cross);
    this.letters();
    this.bar(widthMm);
  }

  pixelCentre(column, row, step) {
    const { right, up, centre } = this.plane, { width, height } = this.canvas;
    return add(centre, add(times(right, (column + 0.5 - width / 2) * step), times(up, (height / 2 - row - 0.5) * step)));
  }

  // Return a function that tells by how much a pixel is pulled back to the masks, null in their phase.
  // It is computed at every so manieth pixel, and between them it is bilinear.
  shifts(width, height, step) {
    const { breath, share } = this.image;
    if (!breath || share === 0) return null;
    const columns = Math.ceil(width / LATTICE_PIXELS) + 1, rows = Math.ceil(height / LATTICE_PIXELS) + 1;
    const known = new Float32Array(3 * columns * rows), out = [0, 0, 0];
    for (let n = 0; n < columns * rows; n++) {
      const place = this.pixelCentre((n % columns) * LATTICE_PIXELS, Math.floor(n / columns) * LATTICE_PIXELS, step);
      known.set(minus(breath.pulledBack(place, share), place), 3 * n);
    }
    return (column, row) => {
      const i = Math.floor(column / LATTICE_PIXELS), j = Math.floor(row / LATTICE_PIXELS);
      const u = column / LATTICE_PIXELS - i, v = row / LATTICE_PIXELS - j;
      const a = 3 * (j * columns + i), b = a + 3 * columns;
      for (let k = 0; k < 3; k++) {
        const top = known[a + k] + u * (known[a + 3 + k] - known[a + k]);
        out[k] = top + v * (known[b + k] + u * (known[b + 3 + k] - known[b + k]) - top);
      }
      return out;
    };
  }

  // Return column, row and distance from the plane in mm.
  project(place) {
    const { right, up, centre, scale } = this.plane;
    const away = minus(place, centre);
    return [
      this.canvas.width / 2 + dot(away, right) * scale, this.canvas.height / 2 - dot(away, up) * scale,
      Math.abs(dot(away, cross(right, up))),
    ];
  }

  // Return the point of the plane at a pixel.
  pointAt(column, row) {
    const { right, up, centre, scale } = this.plane;
    return add(centre, add(
      times(right, (column - this.canvas.width / 2) / scale), times(up, (this.canvas.height / 2 - row) / scale)));
  }

  // A device: full where it is near the plane, faint where it is not.
  line({ points, radius, colour }) {
    const pen = this.pen;
    const places = points.map((place) => this.project(place));
    pen.lineCap = "round";
    pen.strokeStyle = colour;
    for (const near of [false, true]) {
      pen.globalAlpha = near ? 1 : FAINT;
      pen.lineWidth = near ? Math.max(2 * radius * this.plane.scale, 2.5) : 2;
      pen.beginPath();
      for (let n = 1; n < places.length; n++) {
        const [a, b] = [places[n - 1], places[n]];
        if ((Math.min(a[2], b[2]) <= NEAR_MM) !== near) continue;
        pen.moveTo(a[0], a[1]);
        pen.lineTo(b[0], b[1]);
      }
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  target(place) {
    const [x, y, away] = this.project(place);
    const pen = this.pen;
    pen.globalAlpha = away <= NEAR_MM ? 1 : FAINT;
    for (const [colour, width] of [["#000000", 5], ["#39E0B0", 2.5]]) {
      pen.strokeStyle = colour;
      pen.lineWidth = width;
      pen.beginPath();
      pen.arc(x, y, 11, 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  cross(place) {
    const [x, y] = this.project(place);
    const pen = this.pen;
    pen.strokeStyle = INK.cross;
    pen.globalAlpha = 0.55;
    pen.lineWidth = 1;
    pen.beginPath();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
      pen.moveTo(x + 8 * dx, y + 8 * dy);
      pen.lineTo(x + 22 * dx, y + 22 * dy);
    }
    pen.stroke();
    pen.globalAlpha = 1;
  }

  letters() {
    const { right, up } = this.plane;
    const { width, height } = this.canvas;
    const edges = [
      [letters(times(right, -1)), 6, height / 2, "left"], [letters(right), width - 6, height / 2, "right"],
      [letters(up), width / 2, 16, "center"], [letters(times(up, -1)), width / 2, height - 16, "center"],
    ];
    this.edges = edges.map(([name]) => name);
    for (const [name, x, y, align] of edges) this.write(name, x, y, align, "bold 19px system-ui, sans-serif");
  }

  bar(widthMm) {
    const mm = widthMm > 150 ? 50 : widthMm > 80 ? 20 : 10;
    const pen = this.pen;
    const y = this.canvas.height - 9;
    pen.strokeStyle = INK.label;
    pen.lineWidth = 3;
    pen.beginPath();
    pen.moveTo(9, y);
    pen.lineTo(9 + mm * this.plane.scale, y);
    pen.stroke();
    this.write(`${mm} mm`, 9, y - 13, "left", "15px system-ui, sans-serif");
  }

  write(text, x, y, align, font) {
    const pen = this.pen;
    pen.font = font;
    pen.textAlign = align;
    pen.textBaseline = "middle";
    pen.lineWidth = 4;
    pen.strokeStyle = "#000000";
    pen.strokeText(text, x, y);
    pen.fillStyle = INK.label;
    pen.fillText(text, x, y);
  }
}
