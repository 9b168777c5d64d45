// The page of a reachability map.
import { AnatomyPage, byId, openPage } from "./anatomy_page.js";
import { VIRIDIS } from "./colours.js";
import { reportData, unpack } from "./decode.js";
import { STANDARD } from "./slices.js";
import { addSwitch, made, swatch } from "./structures.js";
import { minus, norm, ramp, rgb } from "./vectors.js";
import { VoxelImage } from "./voxel_image.js";

const NO_PATH = [150, 150, 150];
const OVER_SHARE = 0.85;

const bytes = (colour) => colour.map((value) => Math.round(255 * value));

const shade = (share) => bytes(ramp(VIRIDIS, share));

class ReachPage extends AnatomyPage {
  constructor(data) {
    super(data, ["airway", "lung"]);
    this.place = [...data.centre_lps];
    this.number = 0;
  }

  async open() {
    this.maps = await Promise.all(this.data.maps.map(async (map) => ({
      ...map, kindOf: await unpack(map.kind), clearanceOf: await unpack(map.clearance),
    })));
    if (await this.openScene()) await this.addMaps();
    this.image = await VoxelImage.of(this.data);
    this.listControls();
    this.openSlices();
    this.linkSlices({ placed: (place) => this.moveTo(place) });
    this.connectSliders();
    this.views.place = this.place;
    this.draw();
  }

  get map() {
    return this.maps[this.number];
  }

  cutThrough() {
    return { point: this.place, axis: null, name: "the place" };
  }

  distancesOf(point) {
    return [`${norm(minus(point, this.place)).toFixed(1)} mm to the place`];
  }

  async addMaps() {
    for (const [n, map] of this.maps.entries()) {
      for (const packed of map.surfaces) {
        await this.scene.addSurface({ ...packed, key: `${n}: ${packed.key}`, shown: n === 0 && packed.shown });
      }
    }
  }

  listControls() {
    this.listStructures();
    this.boxes = new Map();
    for (const { key, name, colour, shown } of this.maps[0].surfaces) {
      this.boxes.set(key, addSwitch(byId("surfaces"), { key, name, colour, shown }, () => this.showSurfaces()));
    }
    this.maps.forEach((map, n) => byId("system").append(new Option(map.name, n)));
    byId("system").addEventListener("change", (event) => {
      this.number = Number(event.target.value);
      this.showSurfaces();
    });
    byId("quantity").addEventListener("change", this.redraw);
  }

  showSurfaces() {
    if (this.scene) {
      for (const [key, surface] of this.scene.surfaces) {
        const [n, name] = key.split(": ");
        if (name) surface.shown = Number(n) === this.number && this.boxes.has(name) && this.boxes.get(name).checked;
      }
    }
    this.redraw();
  }

  connectSliders() {
    const volume = this.image.labels[0];
    const sizes = [volume.width, volume.height, volume.depth];
    this.views.setWidth(Math.max(...sizes) * volume.spacing);
    this.views.centre = volume.first.map((first, axis) => first + ((sizes[axis] - 1) * volume.spacing) / 2);
    for (let axis = 0; axis < 3; axis++) {
      const slider = byId(`place-${axis}`);
      slider.min = Math.ceil(volume.first[axis]);
      slider.max = Math.floor(volume.first[axis] + (sizes[axis] - 1) * volume.spacing);
      slider.value = this.place[axis];
      slider.addEventListener("input", () => {
        this.moveTo(this.place.map((value, n) => (n === axis ? Number(slider.value) : value)));
      });
    }
  }

  moveTo(place) {
    super.moveTo(place);
    this.views.moveTo(place);
    place.forEach((value, axis) => {
      byId(`place-${axis}`).value = value;
    });
  }

  // Return the index of the map's voxel that holds a point, -1 beyond the map.
  voxel(x, y, z) {
    const [ni, nj, nk] = this.map.shape;
    const m = this.map.ijk_from_lps;
    const [i, j, k] = [0, 1, 2].map((r) => Math.round(m[r][0] * x + m[r][1] * y + m[r][2] * z + m[r][3]));
    return i >= 0 && j >= 0 && k >= 0 && i < ni && j < nj && k < nk ? (k * nj + j) * ni + i : -1;
  }

  // Return what paints the map over the structures.
  painter() {
    const { map } = this;
    const colours = [];
    for (const [name, code] of Object.entries(map.kinds)) colours[code] = bytes(rgb(this.data.colours[name]));
    const reached = [map.kinds["direct arc"], map.kinds.search];
    const byClearance = byId("quantity").value === "clearance";
    const [low, high] = this.data.clearance_range_mm;
    const shades = Array.from({ length: 256 }, (_, n) => shade((n / map.steps_per_mm - low) / (high - low)));
    return (x, y, z) => {
      const at = this.voxel(x, y, z);
      const kind = at < 0 ? 0 : map.kindOf[at];
      if (!kind) return null;
      const colour = byClearance ? (reached.includes(kind) ? shades[map.clearanceOf[at]] : NO_PATH) : colours[kind];
      return colour.map((value) => OVER_SHARE * value);
    };
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    this.image.overlay = this.painter();
    this.views.draw(STANDARD, {}, isCoarse);
    this.panel.show();
    byId("slice-place").textContent = `Through LPS ${this.place.map((v) => v.toFixed(0)).join(", ")} mm: ${this.words()}.`;
    this.showKey();
  }

  // Say what the map says at the place.
  words() {
    const at = this.voxel(...this.place);
    const kind = at < 0 ? 0 : this.map.kindOf[at];
    const named = Object.entries(this.map.kinds).find(([, code]) => code === kind);
    if (!named) return "not counted";
    const clearance = this.map.clearanceOf[at] / this.map.steps_per_mm;
    return clearance > 0 ? `${named[0]}, clearance ${clearance.toFixed(1)} mm` : named[0];
  }

  showKey() {
    const clearance = byId("quantity").value === "clearance";
    const entries = clearance
      ? [0, 0.25, 0.5, 0.75, 1].map((share) => {
        const mm = this.data.clearance_range_mm[1] * share;
        return [`${mm} mm${share === 1 ? " and more" : ""}`, `rgb(${shade(share).join(",")})`];
      }).concat([["no path", `rgb(${NO_PATH.join(",")})`]])
      : Object.entries(this.data.colours);
    byId("key").replaceChildren(...entries.map(([name, colour]) => made("li", {}, swatch(colour), ` ${name}`)));
  }

  // What a test may read; docs/how_to/report.md names the fields.
  report() {
    return {
      ...super.report(), system: this.map.name, quantity: byId("quantity").value, place_lps: this.place, words: this.words(),
    };
  }
}

openPage(new ReachPage(reportData()));
