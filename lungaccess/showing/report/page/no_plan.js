// The page of a search that found no plan.
import { AnatomyPage, openPage } from "./anatomy_page.js";
import { reportData, unpack } from "./decode.js";
import { showBall } from "./devices.js";
import { STANDARD } from "./slices.js";
import { Solids } from "./solids.js";
import { addSwitch, byId } from "./structures.js";
import { minus, norm, point, rgb } from "./vectors.js";
import { VoxelImage } from "./voxel_image.js";

const START_MM = 1.1, FAINT_START_MM = 0.6, BALL_MM = 2.2, PATH_MM = 1.2, AROUND_TARGET_MM = 44;

// Return points as lists of three numbers.
async function pointsOf(packed) {
  const flat = await unpack(packed);
  return Array.from({ length: flat.length / 3 }, (_, n) => point(flat, n));
}

class NoPlanPage extends AnatomyPage {
  constructor(data) {
    super(data, ["airway", "lung"]);
    this.place = [...data.target_lps];
    this.shown = {};
  }

  async open() {
    for (const path of this.data.paths) path.lines = await Promise.all(path.curves.map(pointsOf));
    for (const group of this.data.starts) group.places = await pointsOf(group.points);
    if (await this.openScene()) this.orbit.setHome("target", this.data.target_lps, AROUND_TARGET_MM);
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

  // Add a switch with a name that puts something into the scene, or takes it away.
  list(id, key, { name, colour, shown = true }, put) {
    const change = (on) => {
      this.shown[key] = on;
      if (this.scene) put(on);
      this.redraw();
    };
    addSwitch(byId(id), { key, name, colour, shown }, change);
    change(shown);
  }

  listControls() {
    if (this.scene) showBall(this.scene, "target", this.data.target_lps, BALL_MM);
    for (const group of this.data.starts) {
      const { key, colour, places } = group, radii = key === "out of reach" ? FAINT_START_MM : START_MM;
      const points = { places: places.flat(), colours: places.flatMap(() => rgb(colour)), radii };
      this.list("starts", `start ${key}`, group, (on) => this.scene.setPoints(`start ${key}`, on ? points : null));
    }
    this.data.paths.forEach((path, n) => {
      const tubes = new Solids();
      for (const line of path.lines) tubes.tube(line, Math.max(path.radius_mm, PATH_MM), rgb(path.colour));
      this.list("paths", `path ${n}`, path, (on) => this.scene.setSolids(`path ${n}`, on ? tubes : null));
    });
    this.listStructures();
    const places = [{ name: "the target", lps: this.data.target_lps }, ...this.data.places];
    places.forEach(({ name }, n) => byId("place").append(new Option(name, n)));
    byId("place").addEventListener("change", (event) => this.moveTo([...places[Number(event.target.value)].lps]));
  }

  moveTo(place) {
    super.moveTo(place);
    this.views.lookAt(place);
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    const lines = this.data.paths.flatMap(({ lines: curves, colour, radius_mm: radius }, n) =>
      (this.shown[`path ${n}`] ? curves.map((points) => ({ points, radius, colour })) : []));
    this.views.draw(STANDARD, { lines, target: this.data.target_lps }, isCoarse);
    this.panel.show();
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
