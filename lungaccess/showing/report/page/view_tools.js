// What one does in the 3-D view besides turning it: point, measure, cut, and save a picture or a film.
import { inscribe } from "./slices.js";
import { Solids } from "./solids.js";
import { made, oncePerFrame, shiftBy } from "./structures.js";
import { add, dot, minus, norm, rgb, times, unit } from "./vectors.js";

const MEASURE_INK = "#FFD23F";
const FILM_S = 12;
const FILM_FPS = 25;
const FILM_TYPES = ["video/webm;codecs=vp8", "video/webm", "video/mp4"];
const PARALLEL = 0.98;

// Return the plane through a point, and along an axis if there is one, that faces the viewer, moved towards the viewer.
export function planeFacing(camera, { point, axis }, towardsMm = 0) {
  const across = axis ? minus(camera.forward, times(axis, dot(camera.forward, axis))) : camera.forward;
  const normal = norm(across) < Math.sqrt(1 - PARALLEL * PARALLEL) ? camera.forward : unit(across);
  return { normal, point: minus(point, times(normal, towardsMm)) };
}

// Connects the controls of the figure of the 3-D view with a page, which has a scene, an orbit and words of its own.
export class ViewTools {
  constructor(page, figure) {
    Object.assign(this, { page, figure, canvas: page.scene.canvas, measured: [], measuring: false, recording: null, hit: null });
    this.find = (id) => figure.querySelector(`#${id}`);
    this.connectCut();
    this.connectPointing();
    this.connectMeasuring();
    this.connectSaving();
  }

  connectCut() {
    for (const id of ["cut", "cut-offset", "focus"]) this.find(id).addEventListener("input", () => this.page.redrawView());
  }

  // Bring the cut and the labels to the camera, before and after the picture.
  beforeDrawing(camera) {
    const through = this.page.cutThrough(), on = this.find("cut").checked && through;
    const offset = Number(this.find("cut-offset").value);
    this.find("cut-name").textContent = `Cut through ${through ? through.name : "it"}`;
    this.find("cut-words").textContent = offset ? `${Math.abs(offset)} mm ${offset < 0 ? "behind" : "before"} it` : "in it";
    this.find("focus-row").hidden = !this.page.scene.focus;
    this.page.scene.focused = this.find("focus").checked;
    this.page.scene.setCut(on ? planeFacing(camera, through, offset) : null);
  }

  afterDrawing() {
    const labels = [...this.page.labels?.() ?? [], ...this.measureLabel()];
    this.find("scene-labels").replaceChildren(...labels.flatMap(({ text, point, colour }) => {
      const at = this.page.scene.project(point);
      return at ? made("span", { style: `border-color: ${colour}; transform: ${shiftBy(at)}` }, text) : [];
    }));
  }

  // Pointing ----------------------------------------------------------------------------------------------------------

  connectPointing() {
    const pointSoon = oncePerFrame(() => this.pointer && this.pointAt(...this.pointer));
    this.canvas.addEventListener("pointermove", (event) => {
      if (event.buttons || event.pointerType === "touch") return this.leave();
      this.pointer = [event.offsetX, event.offsetY];
      return pointSoon();
    });
    this.canvas.addEventListener("pointerleave", () => this.leave());
    this.canvas.addEventListener("keydown", (event) => {
      const middle = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
      if (event.key === "Enter") this.say(this.wordsOf(this.page.scene.pick(...middle)));
      else if (event.key === "m") this.measureAt(...middle);
      else if (event.key === "Escape") this.clear();
      else return;
      event.preventDefault();
    });
  }

  pointAt(x, y) {
    this.hit = this.page.scene.pick(x, y);
    const note = this.find("pointed");
    note.hidden = !this.hit;
    if (!this.hit) return;
    note.textContent = this.wordsOf(this.hit);
    const aside = x > this.canvas.clientWidth / 2 ? "calc(-100% - 12px)" : "14px";
    note.style.transform = `${shiftBy([x, y])} translate(${aside}, 14px)`;
  }

  leave() {
    this.pointer = this.hit = null;
    this.find("pointed").hidden = true;
  }

  // Say what a hit is, and how far from the needle and the target.
  wordsOf(hit) {
    if (!hit) return "Nothing there";
    return [this.page.nameOf(hit), ...this.page.distancesOf(hit.point)].join(" · ");
  }

  say(words) {
    this.find("scene-words").textContent = words;
  }

  // Measuring ---------------------------------------------------------------------------------------------------------

  connectMeasuring() {
    this.find("measure").addEventListener("click", () => {
      this.measuring = !this.measuring;
      this.find("measure").setAttribute("aria-pressed", String(this.measuring));
      if (this.measuring) this.say("Click two places in the view, or press m for the one in the middle; Escape ends it");
      else this.clear();
    });
    this.page.orbit.clicked = (event) => {
      if (this.measuring) this.measureAt(event.offsetX, event.offsetY);
      else if (event.pointerType === "touch") this.say(this.wordsOf(this.page.scene.pick(event.offsetX, event.offsetY)));
    };
  }

  measureAt(x, y) {
    const hit = this.page.scene.pick(x, y);
    if (!hit) return this.say("Nothing there to measure from");
    if (this.measured.length > 1) this.measured = [];
    this.measured.push(hit.point);
    this.say(this.measured.length > 1 ? this.measureWords() : `From ${this.wordsOf(hit)}`);
    this.drawMeasure();
    return undefined;
  }

  // Return the length in mm, and how far apart the places are along the devices.
  measureWords() {
    const [a, b] = this.measured, along = this.page.alongMm?.(a, b) ?? null;
    return `${norm(minus(b, a)).toFixed(1)} mm${along === null ? "" : `; ${along.toFixed(1)} mm along tubes and needle`}`;
  }

  measureLabel() {
    if (this.measured.length < 2) return [];
    const [a, b] = this.measured;
    return [{ text: `${norm(minus(b, a)).toFixed(1)} mm`, point: times(add(a, b), 0.5), colour: MEASURE_INK }];
  }

  drawMeasure() {
    const solids = new Solids(), radius = 0.0012 * this.page.orbit.distance, ink = rgb(MEASURE_INK);
    for (const point of this.measured) solids.ball(point, 2 * radius, ink);
    solids.tube(this.measured, 0.7 * radius, ink);
    this.page.scene.setSolids("measure", solids);
    this.page.redrawView();
  }

  clear() {
    this.measured = [];
    this.measuring = false;
    this.find("measure").setAttribute("aria-pressed", "false");
    this.say("");
    this.drawMeasure();
  }

  // Saving ------------------------------------------------------------------------------------------------------------

  connectSaving() {
    for (const { key, name } of this.page.films?.() ?? []) this.find("film-kind").append(new Option(name, key));
    this.find("save-picture").addEventListener("click", async () => save(await this.picture(), `${this.fileName()}.png`));
    this.filmType = this.canvas.captureStream && window.MediaRecorder && FILM_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
    if (!this.filmType) Object.assign(this.find("save-film"), { disabled: true, title: "This browser records no film" });
    this.find("save-film").addEventListener("click", async () => {
      if (this.recording) return this.recording.stop();
      const film = await this.film(this.find("film-kind").value);
      return save(film, `${this.fileName()}.${film.type.includes("mp4") ? "mp4" : "webm"}`);
    });
  }

  fileName() {
    return `${this.page.data.patient} ${this.page.data.page}`.replace(/[^\w.-]+/g, "-");
  }

  // Return a PNG of the view as it is, with the letters of the sides and the labels.
  picture() {
    this.page.show("fine", false);
    const { width, height } = this.canvas, sheet = made("canvas", { width, height });
    this.copyTo(sheet);
    return new Promise((resolve) => sheet.toBlob(resolve, "image/png"));
  }

  // Draw the view as it is, with letters and labels, over all of another canvas.
  copyTo(sheet) {
    const { canvas } = this, pen = sheet.getContext("2d");
    const scale = sheet.width / canvas.clientWidth, frame = canvas.getBoundingClientRect();
    pen.drawImage(canvas, 0, 0, sheet.width, sheet.height);
    const style = getComputedStyle(document.documentElement), [ink, paper] = ["--ink", "--paper"].map((name) => style.getPropertyValue(name).trim());
    for (const element of this.figure.querySelectorAll(".edge, #scene-labels > span")) {
      const box = element.getBoundingClientRect();
      const at = [(box.x + box.width / 2 - frame.x) * scale, (box.y + box.height / 2 - frame.y) * scale];
      inscribe(pen, element.textContent, ...at, "center", `700 ${15 * scale}px`, ink, paper, 3 * scale);
    }
  }

  // Return a film of one turn, or of what the page moves: in the time it takes, with as many pictures as can be drawn.
  async film(kind, seconds = FILM_S) {
    // Even numbers, as encoders want them; the view itself may change its size.
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((px) => 2 * Math.ceil(px / 2));
    const sheet = made("canvas", { width, height });
    this.copyTo(sheet);
    const recorder = new MediaRecorder(sheet.captureStream(FILM_FPS), { mimeType: this.filmType, videoBitsPerSecond: 8e6 });
    const parts = [], ended = new Promise((resolve) => recorder.addEventListener("stop", resolve));
    recorder.addEventListener("dataavailable", (event) => parts.push(event.data));
    this.recording = recorder;
    this.find("save-film").textContent = "Stop film";
    const { yaw } = this.page.orbit;
    recorder.start();
    const start = performance.now();
    while (recorder.state === "recording") {
      const share = Math.min((performance.now() - start) / (1000 * seconds), 1);
      if (kind === "turn") this.page.orbit.yaw = yaw + 2 * Math.PI * share;
      else this.page.filmAt(kind, share);
      this.page.show("moving", kind !== "turn");
      // Else pictures wait in a queue, and the film ends before they are drawn.
      this.page.scene.finish();
      this.copyTo(sheet);
      await new Promise(requestAnimationFrame);
      if (share >= 1) recorder.stop();
    }
    await ended;
    this.recording = null;
    this.page.orbit.yaw = yaw;
    this.find("save-film").textContent = "Save film";
    this.page.redraw();
    return new Blob(parts, { type: recorder.mimeType.split(";")[0] });
  }
}

// Let the browser store a file.
function save(blob, name) {
  const link = made("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
