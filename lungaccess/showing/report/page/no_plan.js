// The page of a search that found no plan.
import { AnatomyPage, byId, openPage } from "./anatomy_page.js";
import { DEVICE_COLOURS } from "./colours.js";
import { reportData, unpack } from "./decode.js";
import { STANDARD } from "./slices.js";
import { Solids } from "./solids.js";
import { addSwitch } from "./structures.js";
import { minus, norm, rgb } from "./vectors.js";
import { VoxelImage } from "./voxel_image.js";

const START_MM = 1.1;
const FAINT_START_MM = 0.6;
const TARGET_MM = 2.2;
const PATH_MM = 1.2;
const AROUND_TARGET_MM = 44;

// Return points as lists of three numbers.
async function pointsOf(packed) {
  const flat = await unpack(packed);
  return Array.from({ length: flat.length / 3 }, (_, n) => [flat[3 * n], flat[3 * n + 1], flat[3 * n + 2]]);
}

class NoPlanPage extends AnatomyPage {
  constructor(data) {
    super(data, ["airway", "lung"]);
    this.place = [...data.target_lps];
    this.solids = new Map();
    this.shown = {};
    this.drawn = {};
  }

  async open() {
    for (const path of this.data.paths) path.lines = await Promise.all(path.curves.map(pointsOf));
    for (const group of this.data.starts) group.places = await pointsOf(group.points);
    if (await this.openScene((size) => 2.1 * Math.max(...size))) {
      this.orbit.setHome("target", this.data.target_lps, AROUND_TARGET_MM);
      this.makeSolids();
    }
    this.image = await VoxelImage.of(this.data);
    this.listControls();
    this.openSlices();
    this.linkSlices({ placed: (place) => super.moveTo(place) });
    this.views.lookAt(this.place);
    this.draw();
  }

  cutThrough() {
    return { point: this.data.target_lps, axis: null, name: "the target" };
  }

  nameOf(hit) {
    const [what, key] = hit.key.split(/ (.*)/);
    if (what === "path") return this.data.paths[Number(key)].name;
    if (what === "start") return `Start of the needle, ${this.data.starts.find((each) => each.key === key).name}`;
    return hit.key === "target" ? "Target" : super.nameOf(hit);
  }

  distancesOf(point) {
    return [`${norm(minus(point, this.data.target_lps)).toFixed(1)} mm to the target`];
  }

  makeSolids() {
    const target = new Solids();
    target.ball(this.data.target_lps, TARGET_MM, rgb(DEVICE_COLOURS.target));
    this.solids.set("target", target);
    this.data.paths.forEach(({ lines, colour, radius_mm: radius }, n) => {
      const tubes = new Solids();
      for (const line of lines) tubes.tube(line, Math.max(radius, PATH_MM), rgb(colour));
      this.solids.set(`path ${n}`, tubes);
    });
  }

  listControls() {
    this.shown.target = true;
    const list = (id, key, name, colour, shown) => {
      this.shown[key] = shown;
      addSwitch(byId(id), { key, name, colour, shown }, (on) => {
        this.shown[key] = on;
        this.redraw();
      });
    };
    for (const { key, name, colour } of this.data.starts) list("starts", `start ${key}`, name, colour, true);
    this.data.paths.forEach(({ name, colour, shown }, n) => list("paths", `path ${n}`, name, colour, shown));
    this.listStructures();
    const places = [{ name: "the target", lps: this.data.target_lps }, ...this.data.places];
    places.forEach(({ name }, n) => byId("place").append(new Option(name, n)));
    byId("place").addEventListener("change", (event) => this.moveTo([...places[Number(event.target.value)].lps]));
  }

  moveTo(place) {
    super.moveTo(place);
    this.views.lookAt(place);
  }

  // Hand over only what was switched since the last picture.
  switchSolids() {
    for (const [key, solids] of this.solids) {
      if (this.drawn[key] === this.shown[key]) continue;
      this.scene.setSolids(key, this.shown[key] ? solids : null);
      this.drawn[key] = this.shown[key];
    }
    for (const { key, colour, places } of this.data.starts) {
      const name = `start ${key}`;
      if (this.drawn[name] === this.shown[name]) continue;
      const radii = key === "out of reach" ? FAINT_START_MM : START_MM, colours = places.flatMap(() => rgb(colour));
      this.scene.setPoints(name, this.shown[name] ? { places: places.flat(), colours, radii } : null);
      this.drawn[name] = this.shown[name];
    }
  }

  drawView() {
    this.switchSolids();
    this.scene.fit();
    this.drawScene();
  }

  draw() {
    if (this.scene) this.drawView();
    if (this.views) this.drawSlices();
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    const lines = this.data.paths.flatMap(({ lines: curves, colour, radius_mm: radius }, n) =>
      (this.shown[`path ${n}`] ? curves.map((points) => ({ points, radius, colour })) : []));
    this.views.draw(STANDARD, { lines, target: this.data.target_lps }, isCoarse);
    this.panel.showField();
    this.panel.describe();
    byId("slice-place").textContent = `Through LPS ${this.place.map((v) => v.toFixed(1)).join(", ")} mm.`;
  }

  // What a test may read; docs/how_to/report.md names the fields.
  report() {
    return {
      ...super.report(), place_lps: this.place, shown: { ...this.shown },
      starts: Object.fromEntries(this.data.starts.map(({ key, places }) => [key, places.length])),
      paths: this.data.paths.map(({ name }) => name),
    };
  }
}

openPage(new NoPlanPage(reportData()));
