// The voxels of a page and how they are painted: structures, a CT, and a further layer over them.
import { TISSUE_COLOURS } from "./colours.js";
import { rgb } from "./vectors.js";
import { linear, nearest, PackedSource, placedVolume, VoxelGrid } from "./voxels.js";

// What is painted over a CT at first, and how densely.
const TINTED = ["airway wall", "vessel", "fissure", "nodule"];
const TINT = 0.45;
const GROUND = ["outside", "lung"];

export const WINDOWS = { lung: [-1350, 150], tissue: [-160, 240], bone: [-500, 1300] };
export const LEAST_WIDTH_HU = 10;

export class VoxelImage {
  static async of(data) {
    const image = new VoxelImage();
    const load = (packed, table) => Promise.all((packed || []).map((each) => placedVolume(each, table)));
    [image.labels, image.ct] = await Promise.all([load(data.labels), load(data.ct, data.hounsfield)]);
    image.grid = data.grid ? new VoxelGrid(data.grid.shape, data.grid.lps_from_ijk) : image.labels[0].grid;
    image.codes = data.codes;
    image.source = image.hasCt ? new PackedSource(image.ct) : null;
    // `finer` is a source that has more than the page; its slices are shown when they come.
    Object.assign(image, { finer: null, overlay: null, breath: null, share: 0, tint: true });
    image.table = new Uint8Array(3 * 256);
    image.ground = new Uint8Array(256);
    image.tinted = new Uint8Array(256);
    image.opacity = new Float32Array(256);
    for (const [name, code] of Object.entries(data.codes)) {
      image.table.set(rgb(TISSUE_COLOURS[name]).map((value) => 255 * value), 3 * code);
      image.ground[code] = GROUND.includes(name) ? 1 : 0;
      image.tinted[code] = TINTED.includes(name) ? 1 : 0;
      image.opacity[code] = image.hasCt ? TINT * image.tinted[code] : 1;
    }
    image.setWindow("lung");
    return image;
  }

  get hasCt() {
    return this.ct.length > 0;
  }

  // Show a window of WINDOWS; any other name leaves it as it is.
  setWindow(name) {
    if (WINDOWS[name]) [this.low, this.high] = WINDOWS[name];
  }

  // Show the values from level - width / 2 to level + width / 2, HU.
  setLevels(level, width) {
    const half = Math.max(width, LEAST_WIDTH_HU) / 2;
    [this.low, this.high] = [level - half, level + half];
  }

  get levels() {
    return { level: (this.low + this.high) / 2, width: this.high - this.low };
  }

  // Return the name of the window that is shown; "" if it is none of WINDOWS.
  get windowName() {
    const found = Object.entries(WINDOWS).find(([, [low, high]]) => low === this.low && high === this.high);
    return found ? found[0] : "";
  }

  // Return name, colour and opacity of the structures that can be painted over others.
  structures() {
    return Object.entries(this.codes).filter(([, code]) => !this.ground[code])
      .map(([name, code]) => ({ name, colour: TISSUE_COLOURS[name], opacity: this.opacity[code] }));
  }

  setOpacity(name, share) {
    this.opacity[this.codes[name]] = share;
  }

  // Return all that the colour of a point follows from; the same values paint the same picture.
  get look() {
    const { labels, ct, low, high, tint, overlay, breath, share, opacity } = this;
    return [...labels, ...ct, low, high, tint, overlay, breath && share, ...opacity];
  }

  // Return where a place of the picture is in the masks: the same, but for the breath.
  inMasks(place) {
    return this.breath && this.share !== 0 ? this.breath.pulledBack(place, this.share) : place;
  }

  structureAt(place) {
    const code = nearest(this.labels, ...this.inMasks(place));
    return Object.keys(this.codes).find((name) => this.codes[name] === code);
  }

  // Return the HU at a place, null without a CT or beyond it.
  huAt(place) {
    const value = this.source ? this.source.value(this.inMasks(place)) : NaN;
    return Number.isNaN(value) ? null : value;
  }

  // Write the colour of the image at a point to out[at...at + 2]; `hu` is the value there, if it is known already.
  paint(x, y, z, out, at, hu) {
    const { hasCt } = this;
    const code = hasCt && !this.tint && !this.overlay ? 0 : nearest(this.labels, x, y, z);
    let red = this.table[3 * code], green = this.table[3 * code + 1], blue = this.table[3 * code + 2];
    if (hasCt || !this.ground[code]) {
      const share = this.tint && !this.ground[code] ? this.opacity[code] : 0;
      const value = hasCt ? (255 * ((hu === undefined ? linear(this.ct, x, y, z) : hu) - this.low)) / (this.high - this.low) : 0;
      const grey = hasCt ? Math.min(Math.max(value, 0), 255) || 0 : this.table[3 * this.codes.lung];
      red = grey + share * (red - grey);
      green = grey + share * (green - grey);
      blue = grey + share * (blue - grey);
    }
    const over = this.overlay && !this.tinted[code] ? this.overlay(x, y, z) : null;
    if (over) {
      const dense = over[3] ?? 1;
      red += dense * (over[0] - red);
      green += dense * (over[1] - green);
      blue += dense * (over[2] - blue);
    }
    out[at] = red;
    out[at + 1] = green;
    out[at + 2] = blue;
    out[at + 3] = 255;
  }
}
