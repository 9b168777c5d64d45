// The page of a reachability map.
import { AnatomyPage, openPage } from "./anatomy_page.js";
import { VIRIDIS } from "./colours.js";
import { reportData, unpack } from "./decode.js";
import { STANDARD } from "./slices.js";
import { addSwitch, byId } from "./structures.js";
import { minus, norm, ramp, rgb } from "./vectors.js";
import { VoxelImage } from "./voxel_image.js";
import { nearest, VoxelGrid, volumeOf } from "./voxels.js";

const OVER_SHARE = 0.85;

const painted = (colour) => colour.map((value) => 255 * OVER_SHARE * value);
const NO_PATH = painted([0.588, 0.588, 0.588]);

class ReachPage extends AnatomyPage {
  constructor(data) {
    super(data, ["airway", "lung"]);
    this.place = [...data.centre_lps];
    this.number = 0;
  }

  async open() {
    this.maps = await Promise.all(this.data.maps.map(async (map) => {
      const grid = new VoxelGrid(map.shape, map.lps_from_ijk), volume = async (packed) => [volumeOf(grid, await unpack(packed))];
      return { ...map, kindOf: await volume(map.kind), clearanceOf: await volume(map.clearance) };
    }));
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
    for (const [key, surface] of this.scene ? this.scene.surfaces : []) {
      const [n, name] = key.split(": ");
      if (name) surface.shown = Number(n) === this.number && this.boxes.has(name) && this.boxes.get(name).checked;
    }
    this.redraw();
  }

  connectSliders() {
    const volume = this.image.labels[0];
    const sizes = [volume.width, volume.height, volume.depth];
    this.views.setWidth(Math.max(...sizes) * volume.spacing);
    this.views.centre = volume.first.map((first, axis) => first + ((sizes[axis] - 1) * volume.spacing) / 2);
    sizes.forEach((size, axis) => {
      const slider = byId(`place-${axis}`), first = volume.first[axis];
      Object.assign(slider, { min: Math.ceil(first), max: Math.floor(first + (size - 1) * volume.spacing), value: this.place[axis] });
      slider.addEventListener("input", () => this.moveTo(this.place.with(axis, Number(slider.value))));
    });
  }

  moveTo(place) {
    super.moveTo(place);
    this.views.moveTo(place);
    place.forEach((value, axis) => (byId(`place-${axis}`).value = value));
  }

  // Return what paints the map over the structures.
  painter() {
    const { kinds, kindOf, clearanceOf, steps_per_mm: stepsPerMm } = this.map, [low, high] = this.data.clearance_range_mm;
    const colours = [], shades = Array.from({ length: 256 }, (_, n) => painted(ramp(VIRIDIS, (n / stepsPerMm - low) / (high - low))));
    for (const [name, code] of Object.entries(kinds)) colours[code] = painted(rgb(this.data.colours[name]));
    if (byId("quantity").value === "kind") return (x, y, z) => colours[nearest(kindOf, x, y, z)];
    const reached = [kinds["direct arc"], kinds.search];
    return (x, y, z) => {
      const kind = nearest(kindOf, x, y, z);
      return reached.includes(kind) ? shades[nearest(clearanceOf, x, y, z)] : kind && NO_PATH;
    };
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    this.image.overlay = this.painter();
    this.views.draw(STANDARD, {}, isCoarse);
    this.panel.show();
    byId("slice-place").textContent = `Through LPS ${this.place.map((v) => v.toFixed(0)).join(", ")} mm: ${this.words()}.`;
  }

  // Say what the map says at the place.
  words() {
    const { kinds, kindOf, clearanceOf, steps_per_mm: stepsPerMm } = this.map, kind = nearest(kindOf, ...this.place);
    if (!kind) return "not counted";
    const name = Object.keys(kinds).find((each) => kinds[each] === kind), mm = nearest(clearanceOf, ...this.place) / stepsPerMm;
    return mm > 0 ? `${name}, clearance ${mm.toFixed(1)} mm` : name;
  }

  // What a test may read; docs/how_to/report.md names the fields.
  report() {
    return {
      ...super.report(), system: this.map.name, quantity: byId("quantity").value, place_lps: this.place, words: this.words(),
    };
  }
}

openPage(new ReachPage(reportData()));
