// What the pages have in common: the 3-D view of the structures, their switches, and the slices.
import { Orbit } from "./orbit.js";
import { Scene } from "./scene.js";
import { Slice, STANDARD } from "./slices.js";
import { addSwitch, connectViews, oncePerFrame, sceneBackground, showEdges } from "./structures.js";

export const byId = (id) => document.getElementById(id);

// A page with its data; `shownFirst` lists the structures that are shown at first, if not those that say so.
export class AnatomyPage {
  constructor(data, shownFirst = null) {
    this.data = data;
    this.structures = shownFirst
      ? data.structures.map((packed) => ({ ...packed, shown: shownFirst.includes(packed.key) }))
      : data.structures;
    this.breath = null;
    this.redraw = oncePerFrame(() => this.draw());
  }

  // Open the 3-D view, and return whether there is one; distanceOf takes the size of the lung in mm.
  async openScene(distanceOf) {
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
    const centre = box.low_lps.map((low, axis) => low + box.size_mm[axis] / 2);
    this.orbit = new Orbit(canvas, centre, distanceOf(box.size_mm), this.redraw);
    connectViews(byId("scene-figure"), this.orbit);
    new ResizeObserver(this.redraw).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.redraw);
    return true;
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

  // Let a click in a slice choose the place.
  followClicks() {
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

  drawScene() {
    this.scene.draw(this.orbit.camera(), sceneBackground());
    showEdges(byId("scene-figure"), this.orbit);
  }

  // What a test may read of every page.
  report() {
    const { scene, slices } = this;
    return {
      structures: scene ? Object.fromEntries([...scene.surfaces].map(([key, s]) => [key, s.shown])) : {},
      triangles: scene ? [...scene.surfaces.values()].reduce((sum, s) => sum + s.count / 3, 0) : 0,
      gl_error: scene ? scene.gl.getError() : null,
      slice_edges: slices ? Object.fromEntries(Object.entries(slices).map(([key, s]) => [key, s.edges])) : {},
    };
  }
}

// Open a page, and let tests and tools see and move it; docs/how_to/report.md says how.
export function openPage(page) {
  window.lungaccessReport = {
    ready: page.open(),
    state: () => page.report(),
    set: (place) => {
      page.moveTo(place);
      page.redraw.now();
    },
    ...(page.data.breath && {
      breathe: (phase) => {
        page.breathe(phase);
        page.redraw.now();
      },
    }),
  };
}
