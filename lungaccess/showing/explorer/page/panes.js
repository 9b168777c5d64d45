// The views: which four are where, the bars between them, and canvases with the pixels of their places.
import { made } from "../report/structures.js";

const AREAS = ["a", "b", "c", "d"], NAMES = { scene: "3-D", axial: "Axial", coronal: "Coronal", sagittal: "Sagittal", bronchoscopy: "Bronchoscopy" };
const MOST_PIXELS = 320_000, LEAST = 12, MOST = 88;
const STEPS = { ArrowLeft: -2, ArrowUp: -2, ArrowRight: 2, ArrowDown: 2 };

export class Panes {
  // changed is called when a view is in another place or of another size.
  constructor(changed) {
    this.changed = changed;
    this.order = Object.keys(NAMES);
    this.panes = Object.fromEntries(this.order.map((name) => [name, document.querySelector(`.pane[data-name="${name}"]`)]));
    for (const [name, pane] of Object.entries(this.panes)) {
      pane.append(made("select", { ariaLabel: `View in the place of ${NAMES[name]}`, onchange: ({ target }) => this.swap(name, target.value) },
        ...this.order.map((key) => new Option(NAMES[key], key))));
    }
    this.swap();
    document.querySelectorAll(".split").forEach(connectSplit);
    const sizes = new ResizeObserver((entries) => {
      for (const { target } of entries) fit(target);
      changed();
    });
    document.querySelectorAll("canvas[id^=slice]").forEach((canvas) => sizes.observe(canvas));
  }

  // Let two views change their places, if any, and put all where they belong.
  swap(a = "", b = "") {
    this.order = this.order.map((name) => ({ [a]: b, [b]: a })[name] ?? name);
    this.order.forEach((name, n) => {
      const pane = this.panes[name];
      pane.hidden = n >= AREAS.length;
      Object.assign(pane.style, { gridArea: AREAS[n] ?? "", order: n });
      pane.querySelector(":scope > select").value = name;
    });
    this.changed();
  }

  isShown(name) {
    return !this.panes[name].hidden;
  }
}

// Give a canvas the pixels of its place, but no more than can be painted soon.
function fit(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas, scale = Math.min(1, Math.sqrt(MOST_PIXELS / (width * height)));
  if (width && height) Object.assign(canvas, { width: Math.round(scale * width), height: Math.round(scale * height) });
}

// Let a bar set the share of the box around it that lies before it, in percent, by dragging and by keys.
function connectSplit(bar) {
  const box = bar.parentElement, isUpright = bar.ariaOrientation === "vertical";
  const set = (percent) => {
    bar.ariaValueNow = Math.round(Math.min(Math.max(percent, LEAST), MOST));
    box.style.setProperty(`--${bar.dataset.share}`, bar.ariaValueNow);
  };
  bar.addEventListener("pointerdown", ({ pointerId }) => bar.setPointerCapture(pointerId));
  bar.addEventListener("pointermove", ({ pointerId, clientX, clientY }) => {
    const { left, top, width, height } = box.getBoundingClientRect();
    if (bar.hasPointerCapture(pointerId)) set(100 * (isUpright ? (clientX - left) / width : (clientY - top) / height));
  });
  bar.addEventListener("keydown", (event) => {
    if (!(event.key in STEPS)) return;
    set(Number(bar.ariaValueNow) + STEPS[event.key]);
    event.preventDefault();
  });
}
