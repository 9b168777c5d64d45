// Planes through the image: standard ones by radiological convention, and any other.
import { add, cross, dot, letters, minus, norm, times, unit } from "./vectors.js";

const INK = "#F2F2F2", CROSS_INK = "#FFFFFF";
const NEAR_MM = 2;
const FAINT = 0.5;
const LATTICE_PIXELS = 8;
const NOWHERE = [0, 0, 0];
const KEY_DIGITS = 6, COARSE_PIXELS = 3;
const BARS_MM = [0.5, 1, 2, 5, 10, 20, 50, 100];
const CROSS_GAP = 9;
// A line that is bent less lies in every plane through its ends.
const STRAIGHT_MM = 0.05;

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

// Return the plane that holds a direction, which goes up in the picture; `beside` is in it to the right, and it is then
// turned about the direction by degrees.
export function planeAlong(direction, beside, degrees = 0) {
  const up = unit(direction), first = unit(minus(beside, times(up, dot(beside, up)))), second = cross(up, first);
  const angle = (degrees * Math.PI) / 180;
  return { right: add(times(first, Math.cos(angle)), times(second, Math.sin(angle))), up };
}

// Return the direction from the first to the last point of a line, and the side to which it bends most; `otherwise` is
// the side of a straight one.
export function bendOf(points, otherwise) {
  const first = points[0], direction = unit(minus(points[points.length - 1], first));
  let beside = [0, 0, 0];
  for (const place of points) {
    const away = minus(place, first), aside = minus(away, times(direction, dot(away, direction)));
    if (norm(aside) > norm(beside)) beside = aside;
  }
  return { direction, beside: norm(beside) > STRAIGHT_MM ? unit(beside) : otherwise };
}

// One plane on a canvas, with the devices, the target and the patient's sides at its edges.
export class Slice {
  constructor(canvas, image) {
    this.canvas = canvas;
    this.image = image;
    // Its pixels are painted here, and some are read back: they stay with the processor.
    this.pen = canvas.getContext("2d", { willReadFrequently: true });
  }

  // Draw the plane { right, up } through a centre, so many mm wide, and again when a finer source has its values.
  // marks: { lines: [{ points, radius, colour }], target, targetRadius, cross: [x, y, z] }
  // A coarse picture has the colour of every so-manieth pixel.
  draw(plane, centre, widthMm, marks, isCoarse = false) {
    this.plane = { ...plane, centre, scale: this.canvas.width / widthMm };
    this.marks = marks;
    this.isCoarse = isCoarse;
    this.show(this.isFine ? this.fine.values : null);
    if (!isCoarse) this.refine();
  }

  // Return the pixels of the plane as a source takes them.
  raster() {
    const { width, height } = this.canvas, { right, up, scale } = this.plane;
    return {
      origin: this.pointAt(0.5, 0.5), across: times(right, 1 / scale), down: times(up, -1 / scale), columns: width, rows: height,
    };
  }

  // Return a text that is the same for rasters that differ by less than can be seen.
  key() {
    return JSON.stringify(this.raster(), (_name, value) => (typeof value === "number" ? Number(value.toFixed(KEY_DIGITS)) : value));
  }

  // Ask the finer source, one slice at a time, until what is shown is of it.
  async refine() {
    const { image } = this;
    if (!image.finer || this.asking || (image.breath && image.share !== 0)) return;
    this.asking = true;
    try {
      while (!this.isFine) {
        const key = this.key(), values = await image.finer.slice(this.raster());
        if (!values) return;
        this.fine = { key, values };
        if (key === this.key()) this.show(values);
      }
    } finally {
      this.asking = false;
    }
  }

  // Whether the finer source's values of this very plane are known.
  get isFine() {
    return Boolean(this.fine && this.plane && this.fine.key === this.key());
  }

  // Return the HU at a place of the plane: of the finer source if it is shown, else of the page; null without a CT.
  huAt(place) {
    if (!this.isFine) return this.image.huAt(place);
    const { width, height } = this.canvas, [column, row] = this.project(place).map(Math.floor);
    const value = column >= 0 && row >= 0 && column < width && row < height ? this.fine.values[row * width + column] : NaN;
    return Number.isNaN(value) ? null : value;
  }

  // Paint the pixels, of these values in HU or else of those of the page, and all marks.
  show(values) {
    const { marks, painted } = this, look = [this.key(), values, ...this.image.look];
    // Marks move far more often than the plane behind them.
    const isSame = painted && look.length === painted.look.length && look.every((each, n) => each === painted.look[n]);
    if (!isSame || (painted.isCoarse && !this.isCoarse)) {
      this.paint(values);
      this.painted = { look, isCoarse: this.isCoarse };
    } else this.pen.putImageData(this.ground, 0, 0);
    for (const line of marks.lines || []) this.line(line);
    if (marks.target) this.target(marks.target);
    if (marks.cross) this.cross(marks.cross);
  }

  // Paint what is behind the marks, and keep it: the plane, the patient's sides at its edges, and a bar of known length.
  paint(values) {
    const { pen, canvas: { width, height } } = this;
    this.paintPixels(values);
    pen.putImageData(this.pixels, 0, 0);
    this.letters();
    scaleBar(pen, this.plane.scale);
    this.ground = pen.getImageData(0, 0, width, height);
  }

  // Paint the pixels of the plane.
  paintPixels(values) {
    const { width, height } = this.canvas, step = 1 / this.plane.scale, many = this.isCoarse ? COARSE_PIXELS : 1;
    if (!this.pixels || this.pixels.width !== width || this.pixels.height !== height) this.pixels = this.pen.createImageData(width, height);
    const { data } = this.pixels, words = new Uint32Array(data.buffer);
    const across = times(this.plane.right, many * step);
    const shifts = this.shifts(width, height);
    for (let row = 0; row < height; row += many) {
      let [x, y, z] = this.pointAt(0.5, row + 0.5);
      for (let column = 0; column < width; column += many) {
        const at = row * width + column, [sx, sy, sz] = shifts ? shifts(column, row) : NOWHERE;
        this.image.paint(x + sx, y + sy, z + sz, data, 4 * at, values ? values[at] : undefined);
        if (many > 1) words.fill(words[at], at, Math.min(at + many, (row + 1) * width));
        x += across[0];
        y += across[1];
        z += across[2];
      }
      for (let next = row + 1; next < Math.min(row + many, height); next++) words.copyWithin(next * width, row * width, (row + 1) * width);
    }
  }

  // Return a function that tells by how much a pixel is pulled back to the masks, null in their phase.
  // It is computed at every so manieth pixel, and between them it is bilinear.
  shifts(width, height) {
    const { breath, share } = this.image;
    if (!breath || share === 0) return null;
    const columns = Math.ceil(width / LATTICE_PIXELS) + 1, rows = Math.ceil(height / LATTICE_PIXELS) + 1;
    const known = new Float32Array(3 * columns * rows), out = [0, 0, 0];
    for (let n = 0; n < columns * rows; n++) {
      const place = this.pointAt((n % columns) * LATTICE_PIXELS + 0.5, Math.floor(n / columns) * LATTICE_PIXELS + 0.5);
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

  // Return the point of the plane at a place of the canvas; the centres of pixels are at halves.
  pointAt(column, row) {
    const { right, up, centre, scale } = this.plane, { width, height } = this.canvas, step = 1 / scale;
    return add(centre, add(times(right, (column - width / 2) * step), times(up, (height / 2 - row) * step)));
  }

  // A device: full where it is near the plane, faint where it is not.
  line({ points, radius, colour }) {
    const { pen } = this, places = points.map((place) => this.project(place));
    pen.lineCap = pen.lineJoin = "round";
    pen.strokeStyle = colour;
    for (const near of [false, true]) {
      pen.globalAlpha = near ? 1 : FAINT;
      pen.lineWidth = near ? Math.max(2 * radius * this.plane.scale, 2.5) : 2;
      pen.beginPath();
      for (let n = 1, goesOn = false; n < places.length; n++) {
        const [a, b] = [places[n - 1], places[n]], isShown = (Math.min(a[2], b[2]) <= NEAR_MM) === near;
        if (isShown && !goesOn) pen.moveTo(a[0], a[1]);
        if (isShown) pen.lineTo(b[0], b[1]);
        goesOn = isShown;
      }
      pen.stroke();
    }
    pen.globalAlpha = 1;
  }

  target(place) {
    const [x, y, away] = this.project(place), { pen } = this;
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

  // The cross: where the other planes cut this one.
  cross(place) {
    const [x, y, away] = this.project(place), { width, height } = this.canvas, pen = this.pen;
    pen.strokeStyle = CROSS_INK;
    pen.globalAlpha = away <= NEAR_MM ? 0.6 : 0.3;
    pen.lineWidth = 1;
    pen.beginPath();
    const across = [[0, y, x - CROSS_GAP, y], [x + CROSS_GAP, y, Math.max(width, x + CROSS_GAP), y]];
    const down = [[x, 0, x, y - CROSS_GAP], [x, y + CROSS_GAP, x, Math.max(height, y + CROSS_GAP)]];
    for (const [x0, y0, x1, y1] of [...across, ...down]) {
      pen.moveTo(x0, y0);
      pen.lineTo(x1, y1);
    }
    pen.stroke();
    pen.globalAlpha = 1;
  }

  letters() {
    const { plane: { right, up }, canvas: { width, height } } = this;
    const edges = [
      [letters(times(right, -1)), 6, height / 2, "left"], [letters(right), width - 6, height / 2, "right"],
      [letters(up), width / 2, 16, "center"], [letters(times(up, -1)), width / 2, height - 16, "center"],
    ];
    this.edges = edges.map(([name]) => name);
    for (const [name, x, y, align] of edges) inscribe(this.pen, name, x, y, align, "bold 19px");
  }
}

// Draw a bar of a round length at the lower left of a picture of so many pixels for a mm.
export function scaleBar(pen, scale) {
  const { width, height } = pen.canvas, mm = Math.max(BARS_MM[0], ...BARS_MM.filter((each) => each * scale <= 0.3 * width));
  pen.fillStyle = INK;
  pen.fillRect(9, height - 10.5, mm * scale, 3);
  inscribe(pen, `${mm} mm`, 9, height - 22, "left", "15px");
}

// Write a text in light letters with a dark rim, which are read on any ground.
export function inscribe(pen, text, x, y, align, font, ink = INK, rim = "#000000", rimPx = 4) {
  Object.assign(pen, { font: `${font} system-ui, sans-serif`, textAlign: align, textBaseline: "middle", lineJoin: "round", lineWidth: rimPx, strokeStyle: rim, fillStyle: ink });
  pen.strokeText(text, x, y);
  pen.fillText(text, x, y);
}
