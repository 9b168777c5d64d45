// The page of a search that found no plan.
import { reportData, unpack } from "./decode.js";
import { Orbit } from "./orbit.js";
import { Scene } from "./scene.js";
import { Slice, STANDARD, VoxelImage } from "./slices.js";
import { Solids } from "./solids.js";
import { addSwitch, connectViews, oncePerFrame, sceneBackground, showEdges } from "./structures.js";
import { rgb } from "./vectors.js";

const START_MM = 1.1;
const FAINT_START_MM = 0.6;
const TARGET_MM = 2.2;
const PATH_MM = 1.2;
const ROWS = 4;

const element = (id) => document.getElementById(id);

// Return points as lists of three numbers.
async function pointsOf(packed) {
  const flat = await unpack(packed);
  return Array.from({ length: flat.length / 3 }, (_, n) => [flat[3 * n], flat[3 * n + 1], flat[3 * n + 2]]);
}

class NoPlanPage {
  constructor(data) {
    this.data = data;
    this.place = [...data.target_lps];
    this.solids = new Map();
    this.shown = {};
    this.drawn = {};
    this.redraw = oncePerFrame(() => this.draw());
  }

  async open() {
    for (const path of this.data.paths) path.lines = await Promise.all(path.curves.map(pointsOf));
    for (const group of this.data.starts) group.places = await pointsOf(group.points);
    await this.openScene();
    this.image = await VoxelImage.of(this.data);
    this.listControls();
    this.openSlices();
    this.draw();
  }

  async openScene() {
    try {
      this.scene = new Scene(element("scene"));
    } catch (error) {
      element("no-scene").hidden = false;
      element("no-scene").textContent = `No 3-D view: ${error.message}.`;
      return;
    }
    for (const packed of this.data.structures) {
      await this.scene.addSurface({ ...packed, shown: ["airway", "lung"].includes(packed.key) });
    }
    const box = this.data.structures.find(({ key }) => key === "lung") || this.data.structures[0];
    const centre = box.low_lps.map((low, axis) => low + box.size_mm[axis] / 2);
    this.orbit = new Orbit(element("scene"), centre, 2.1 * Math.max(...box.size_mm), this.redraw);
    connectViews(element("scene-figure"), this.orbit);
    element("view-target").addEventListener("click", () => this.orbit.approach(this.data.target_lps, 170));
    new ResizeObserver(this.redraw).observe(element("scene"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.redraw);
    this.makeSolids();
  }

  makeSolids() {
    const target = new Solids();
    target.ball(this.data.target_lps, TARGET_MM, rgb("#39E0B0"));
    this.solids.set("target", target);
    for (const { key, colour, places } of this.data.starts) {
      const balls = new Solids();
      const radius = key === "out of reach" ? FAINT_START_MM : START_MM;
      for (const place of places) balls.ball(place, radius, rgb(colour), ROWS);
      this.solids.set(`start ${key}`, balls);
    }
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
      addSwitch(element(id), { key, name, colour, shown }, (on) => {
        this.shown[key] = on;
        this.redraw();
      });
    };
    for (const { key, name, colour } of this.data.starts) list("starts", `start ${key}`, name, colour, true);
    this.data.paths.forEach(({ name, colour, shown }, n) => list("paths", `path ${n}`, name, colour, shown));
    for (const packed of this.data.structures) {
      const shown = this.scene ? this.scene.surfaces.get(packed.key).shown : false;
      addSwitch(element("structures"), { ...packed, shown }, (on) => {
        if (this.scene) this.scene.surfaces.get(packed.key).shown = on;
        this.redraw();
      });
    }
  }

  openSlices() {
    this.slices = Object.fromEntries(
      Object.keys(STANDARD).map((name) => [name, new Slice(element(`slice-${name}`), this.image)]));
    const places = [{ name: "the target", lps: this.data.target_lps }, ...this.data.places];
    places.forEach(({ name }, n) => element("place").append(new Option(name, n)));
    element("place").addEventListener("change", (event) => this.moveTo([...places[Number(event.target.value)].lps]));
    element("field").addEventListener("change", this.redraw);
    for (const slice of Object.values(this.slices)) {
      slice.canvas.addEventListener("click", (event) => {
        const scale = slice.canvas.width / slice.canvas.clientWidth;
        this.moveTo(slice.pointAt(event.offsetX * scale, event.offsetY * scale));
      });
    }
  }

  moveTo(place) {
    this.place = place;
    this.redraw();
  }

  // Hand over only what was switched since the last picture.
  switchSolids() {
    for (const [key, solids] of this.solids) {
      if (this.drawn[key] === this.shown[key]) continue;
      this.scene.setSolids(key, this.shown[key] ? solids : null);
      this.drawn[key] = this.shown[key];
    }
  }

  draw() {
    if (this.scene) {
      this.switchSolids();
      this.scene.fit();
      this.scene.draw(this.orbit.camera(), sceneBackground());
      showEdges(element("scene-figure"), this.orbit);
    }
    if (!this.slices) return;
    const lines = this.data.paths.flatMap(({ lines: curves, colour, radius_mm: radius }, n) =>
      (this.shown[`path ${n}`] ? curves.map((points) => ({ points, radius, colour })) : []));
    const marks = { lines, target: this.data.target_lps, cross: this.place };
    const width = Number(element("field").value);
    for (const [name, plane] of Object.entries(STANDARD)) this.slices[name].draw(plane, this.place, width, marks);
    element("slice-place").textContent = `Through LPS ${this.place.map((v) => v.toFixed(1)).join(", ")} mm.`;
  }

  // What a test may read.
  report() {
    return {
      place_lps: this.place, shown: { ...this.shown },
      starts: Object.fromEntries(this.data.starts.map(({ key, places }) => [key, places.length])),
      paths: this.data.paths.map(({ name }) => name),
      triangles: this.scene ? [...this.scene.surfaces.values()].reduce((sum, s) => sum + s.count / 3, 0) : 0,
      gl_error: this.scene ? this.scene.gl.getError() : null,
    };
  }
}

const noPlanPage = new NoPlanPage(reportData());
window.lungaccessReport = {
  ready: noPlanPage.open(),
  state: () => noPlanPage.report(),
  set: (place) => {
    noPlanPage.moveTo(place);
    noPlanPage.draw();
  },
};
