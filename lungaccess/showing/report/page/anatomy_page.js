// What the pages have in common: the 3-D view of the structures, their switches, and the slices.
import { publishColours } from "./colours.js";
import { Orbit } from "./orbit.js";
import { Scene, VIEW_HALF_ANGLE } from "./scene.js";
import { SlicePanel } from "./slice_panel.js";
import { SliceViews } from "./slice_views.js";
import { Slice, STANDARD } from "./slices.js";
import { addSwitch, byId, oncePerFrame, shiftBy } from "./structures.js";
import { rgb } from "./vectors.js";
import { ViewTools } from "./view_tools.js";

// A slow machine draws coarsely while something moves, well when it has rested for a moment, and finely after another
// one.  A moment is at least so many ms, and a few times as long as the last picture took.
const REST_MS = 300, FINE_MS = 900, PICTURES = 4;

// A page with its data; `shownFirst` lists the structures that are shown at first, if not those that say so.  It has
//   cutThrough(): through which point a cut goes, along which axis, and what it is called, null for no cut;
//   distancesOf(point): words on how far a point is from what matters.
// It may have
//   labels(): those in the view, { text, point: LPS mm, colour };
//   alongMm(a, b): how far apart two points are along the devices, in mm, null without devices;
//   films(): what films can show besides a turn, { key, name }; filmAt(key, share) then moves the page.
export class AnatomyPage {
  constructor(data, shownFirst = null) {
    this.data = data;
    this.structures = shownFirst
      ? data.structures.map((packed) => ({ ...packed, shown: shownFirst.includes(packed.key) }))
      : data.structures;
    this.breath = null;
    publishColours();
    this.redraw = oncePerFrame((atOnce) => this.show(atOnce ? "rest" : "moving"));
    this.redrawView = oncePerFrame((atOnce) => this.show(atOnce ? "rest" : "moving", false));
  }

  // Draw all, or the 3-D view alone, in a quality of that; on a slow machine better when nothing moves any more.
  show(quality, all = true) {
    // While a page opens it is drawn once, at the end.
    if (this.isOpening) return;
    clearTimeout(this.better);
    if (this.scene) this.scene.quality = quality;
    const now = performance.now(), took = Math.min(now - (this.shownAt || 0), REST_MS);
    this.shownAt = now;
    if (all) this.draw();
    else this.drawView();
    this.drawBetter(quality, all, took);
  }

  // On a slow machine, draw better when nothing has moved for a moment.
  drawBetter(quality, all = false, took = 0) {
    if (!this.scene || !this.scene.slow || (this.tools && this.tools.recording)) return;
    // Else the pictures of a movement wait in a queue and come late.
    if (quality === "moving") this.scene.finish();
    // What else was drawn in a hurry is drawn better with it.
    this.hasHurried = quality !== "fine" && (this.hasHurried || all);
    if (quality === "fine") return;
    const [next, ms] = quality === "moving" ? ["rest", REST_MS] : ["fine", FINE_MS];
    this.better = setTimeout(() => this.show(next, this.hasHurried), Math.max(ms, PICTURES * took));
  }

  // Return whether a picture is left out for now: it cannot be seen, and a slow machine is in a hurry.
  leavesOut(canvas) {
    const { top, bottom } = canvas.getBoundingClientRect();
    return Boolean(this.scene && this.scene.slow && this.scene.quality === "moving" && (bottom <= 0 || top >= window.innerHeight));
  }

  // Return whether slices are painted coarsely for now: something moves, and the machine is slow; they are then painted
  // well when nothing has moved for a moment.
  hurriesSlices() {
    const { scene, views } = this;
    if (!scene || !scene.slow || (scene.quality !== "moving" && !views.fingers.size)) return false;
    clearTimeout(this.betterSlices);
    this.betterSlices = setTimeout(() => this.drawSlices(false), REST_MS);
    return true;
  }

  draw() {
    if (this.scene) this.drawView();
    if (this.views) this.drawSlices();
  }

  drawView() {
    this.scene.fit();
    this.drawScene();
  }

  // Open the 3-D view, so far away that the whole lung is seen at once, and return whether there is one.
  async openScene() {
    const canvas = byId("scene");
    try {
      this.scene = new Scene(canvas);
    } catch (error) {
      byId("no-scene").hidden = false;
      byId("no-scene").textContent = `No 3-D view: ${error.message}.`;
      return false;
    }
    // One after the other: the order in which surfaces are added is that in which they are drawn.
    for (const packed of this.structures) await this.scene.addSurface(packed, this.breath);
    const box = this.structures.find(({ key }) => key === "lung") || this.structures[0];
    const size = box.size_mm, centre = box.low_lps.map((low, axis) => low + size[axis] / 2);
    const distance = (1.05 * Math.max(...size)) / Math.tan(VIEW_HALF_ANGLE) / 2 + size[1] / 2;
    this.orbit = new Orbit(canvas, centre, distance, this.redrawView);
    byId("scene-figure").addEventListener("click", ({ target: { dataset: { view, fit } } }) => {
      if (view) this.orbit.look(view);
      if (fit) this.orbit.fit(fit);
    });
    new ResizeObserver(() => {
      const [width, height] = this.scene.fitted || [];
      if (canvas.clientWidth !== width || canvas.clientHeight !== height) this.redraw.now();
    }).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.redraw);
    if (byId("save-picture")) this.tools = new ViewTools(this, byId("scene-figure"));
    return true;
  }

  // Name what was hit in the 3-D view.
  nameOf({ kind, key }) {
    return kind === "surface" ? this.scene.surfaces.get(key).name : key;
  }

  listStructures() {
    for (const structure of this.structures) {
      addSwitch(byId("structures"), structure, (on) => {
        if (this.scene) this.scene.surfaces.get(structure.key).shown = on;
        this.redraw();
      });
    }
  }

  openSlices(names = Object.keys(STANDARD)) {
    this.slices = Object.fromEntries(names.map((name) => [name, new Slice(byId(`slice-${name}`), this.image)]));
  }

  // Connect the slices with each other, with their controls and with the 3-D view; `drawSlices` draws them.  What is
  // changed in them is drawn without the 3-D view.
  linkSlices({ placed = () => {}, picked = () => {} } = {}) {
    this.redrawSlices = oncePerFrame(() => this.drawSlices());
    const moved = (place) => {
      placed(place);
      this.showCross();
    };
    this.views = new SliceViews(this.slices, this.image, {
      changed: this.redrawSlices, moved, picked,
      pointed: (place, name) => this.panel.describe(place, name), windowed: () => this.panel.showWindow(),
    });
    this.panel = new SlicePanel(this.views, (place) => this.distancesOf(place));
    if (!this.scene) return;
    const { canvas } = this.scene;
    const take = (x, y) => {
      const hit = this.scene.pick(x, y);
      if (!hit) return;
      this.views.lookAt(hit.point);
      moved(hit.point);
    };
    canvas.addEventListener("dblclick", (event) => take(event.offsetX, event.offsetY));
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "c") take(canvas.clientWidth / 2, canvas.clientHeight / 2);
    });
  }

  // Show where the cross of the slices is in the 3-D view.
  showCross() {
    if (!this.scene || !this.views) return;
    const at = this.scene.project(this.views.place), cross = document.querySelector(".scene-cross");
    cross.hidden = !at;
    if (at) cross.style.transform = shiftBy(at);
  }

  moveTo(place) {
    this.place = place;
    this.redraw();
  }

  drawScene() {
    const camera = this.orbit.camera();
    if (this.tools) this.tools.beforeDrawing(camera);
    this.scene.draw(camera, rgb(getComputedStyle(document.documentElement).getPropertyValue("--scene").trim()));
    const edges = this.orbit.edges();
    document.querySelectorAll("#scene-figure .edge").forEach((element, n) => (element.textContent = edges[n]));
    for (const button of document.querySelectorAll("#scene-figure [data-fit]")) button.hidden = !this.orbit.homes[button.dataset.fit];
    if (this.tools) this.tools.afterDrawing();
    this.showCross();
  }

  // What a test may read of every page.
  report() {
    const { scene, slices, views } = this;
    return {
      structures: scene ? Object.fromEntries([...scene.surfaces].map(([key, s]) => [key, s.shown])) : {},
      triangles: scene ? [...scene.surfaces.values()].reduce((sum, s) => sum + s.count / 3, 0) : 0,
      gl_error: scene ? scene.gl.getError() : null,
      view_tools: scene ? { slow: scene.slow, cut: scene.cut, quality: scene.quality, points: [...scene.points.keys()] } : null,
      slices: views ? { place_lps: views.place, centre_lps: views.centre, width_mm: views.widthMm, window: this.image.levels } : null,
      slice_edges: slices ? Object.fromEntries(Object.entries(slices).map(([key, s]) => [key, s.edges])) : {},
    };
  }
}

// Open a page, and let tests and tools see and move it; docs/how_to/report.md says how.
export function openPage(page) {
  page.isOpening = true;
  window.lungaccessReport = {
    ready: page.open().then(() => {
      page.isOpening = false;
      page.drawBetter("rest");
    }),
    state: () => page.report(),
    set: (place) => {
      page.moveTo(place);
      page.redraw.now();
    },
    slice: (raster) => page.image.source && page.image.source.slice(raster),
    pick: (x, y, options) => page.scene.pick(x, y, options),
    project: (point) => page.scene.project(point),
    ...(page.data.breath && {
      breathe: (phase) => {
        page.breathe(phase);
        page.redraw.now();
      },
    }),
  };
}
