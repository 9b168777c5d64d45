// Slices that belong together: one cross in all of them, moved, scrolled, zoomed and windowed by mouse, fingers and keys.
import { connectGestures } from "./gestures.js";
import { add, cross, dot, minus, times } from "./vectors.js";

const LEAST_MM = 8, MOST_MM = 600;
const WHEEL_PX = 60, ZOOM_PER_PX = 0.0015;
// A dragged pixel of the page changes level and width by so much of the width, but at least by so many HU.
const WINDOW_SHARE = 0.004, LEAST_WINDOW_HU = 1;
const SHIFTS = { ArrowLeft: [-1, 0, 0], ArrowRight: [1, 0, 0], ArrowUp: [0, 1, 0], ArrowDown: [0, -1, 0], PageUp: [0, 0, -1], PageDown: [0, 0, 1] };
const FAST = 10;
const ZOOM = 1.25;

// The view of one slice: right and up of its plane, and what looks at the viewer.
const facing = ({ right, up }) => cross(right, up);

export class SliceViews {
  // slices: { name: Slice }.  Functions that are told of what happens, all but `changed` optional:
  //   changed(): something has to be drawn again;      moved(place, name): the cross was moved in a slice;
  //   picked(place, name): a click or Enter chose a place, LPS mm;   pointed(place, name): the pointer is there, null when it left;
  //   windowed(): the window of the CT was changed.
  constructor(slices, image, { changed, moved = () => {}, picked = () => {}, pointed = () => {}, windowed = () => {} }) {
    Object.assign(this, { slices, image, changed, moved, picked, pointed, windowed });
    this.place = [0, 0, 0];
    this.centre = [0, 0, 0];
    this.widthMm = 140;
    // What a drag does: "cross", "window" or "pan".
    this.dragging = "cross";
    this.fingers = new Map();
    this.rolled = 0;
    for (const [name, slice] of Object.entries(slices)) this.connect(name, slice);
  }

  connect(name, slice) {
    const { canvas } = slice;
    const listen = (kind, act, options) => canvas.addEventListener(kind, (event) => act.call(this, event, name, slice), options);
    canvas.tabIndex = 0;
    canvas.classList.add("moved");
    listen("wheel", this.wheel, { passive: false });
    connectGestures(canvas, this.fingers, {
      pressed: (event) => this.press(event, name, slice),
      dragged: (event, by) => this.drag(event, by, name, slice),
      pinched: (event, factor, by) => {
        this.zoom(factor, this.placeAt(event, slice));
        this.pan(...by, slice);
      },
      tapped: (event) => this.tap(event, name, slice),
      hovered: (event) => this.pointed(this.placeAt(event, slice), name),
    });
    listen("pointerleave", () => this.pointed(null, name));
    listen("contextmenu", (event) => event.preventDefault());
    listen("dblclick", () => this.lookAt(this.place));
    listen("keydown", this.key);
  }

  // Put the cross to a place; the pictures stay where they are unless it would be beyond them.
  moveTo(place) {
    this.place = [...place];
    const reach = 0.45 * this.widthMm;
    if (place.some((value, axis) => Math.abs(value - this.centre[axis]) > reach)) this.centre = [...place];
    this.changed();
  }

  // Put cross and the middle of all pictures to a place.
  lookAt(place) {
    this.place = [...place];
    this.centre = [...place];
    this.changed();
  }

  setWidth(mm) {
    this.widthMm = Math.min(Math.max(mm, LEAST_MM), MOST_MM);
    this.changed();
  }

  zoom(factor, about = this.centre) {
    const before = this.widthMm;
    this.setWidth(before * factor);
    this.centre = add(about, times(minus(this.centre, about), this.widthMm / before));
  }

  // Draw planes: { name: { right, up, through, widthMm } }, through the cross and as wide as all if they do not say.
  draw(planes, marks, isCoarse = false) {
    for (const [name, { right, up, through = this.place, widthMm = this.widthMm }] of Object.entries(planes)) {
      const away = minus(this.centre, through);
      const middle = add(through, add(times(right, dot(away, right)), times(up, dot(away, up))));
      this.slices[name].draw({ right, up }, middle, widthMm, { ...marks, cross: this.place }, isCoarse);
    }
  }

  // Return the place under a pointer.
  placeAt(event, slice) {
    const scale = slice.canvas.width / slice.canvas.clientWidth;
    return slice.pointAt(event.offsetX * scale, event.offsetY * scale);
  }

  // Move the cross by whole layers of voxels: to the viewer's right, up, and towards the viewer.
  step(slice, [right, up, near], many = 1) {
    const { plane } = slice;
    const shift = [[plane.right, right], [plane.up, up], [facing(plane), near]].filter(([, count]) => count)
      .map(([direction, count]) => times(direction, many * count * this.image.grid.stepAlong(direction)));
    return shift.reduce(add, this.place);
  }

  wheel(event, name, slice) {
    event.preventDefault();
    const px = event.deltaMode === 1 ? 40 * event.deltaY : event.deltaMode === 2 ? 400 * event.deltaY : event.deltaY;
    if (event.ctrlKey || event.metaKey) {
      this.zoom(Math.exp(ZOOM_PER_PX * px), this.placeAt(event, slice));
      return;
    }
    this.rolled += px;
    const layers = Math.trunc(this.rolled / WHEEL_PX);
    this.rolled -= layers * WHEEL_PX;
    if (layers) this.set(this.step(slice, [0, 0, layers]), name);
  }

  set(place, name) {
    this.moveTo(place);
    this.moved(place, name);
  }

  press(event, name, slice) {
    if (event.button === 1) event.preventDefault();
    if (this.kindOf(event) === "cross" && event.pointerType === "mouse") this.set(this.placeAt(event, slice), name);
  }

  // What a pointer that is down does.
  kindOf(event) {
    if (event.buttons === 2 || event.button === 2) return "window";
    if (event.buttons === 4 || event.button === 1 || event.shiftKey) return "pan";
    return this.dragging;
  }

  drag(event, [dx, dy], name, slice) {
    const kind = this.kindOf(event);
    if (kind === "pan") this.pan(dx, dy, slice);
    else if (kind === "window") this.window(dx, -dy);
    else this.set(this.placeAt(event, slice), name);
  }

  pan(dx, dy, { plane, canvas }) {
    const mm = canvas.width / canvas.clientWidth / plane.scale;
    this.centre = add(this.centre, add(times(plane.right, -dx * mm), times(plane.up, dy * mm)));
    this.changed();
  }

  // Widen the window of the CT, and raise its level.
  window(wider, higher) {
    if (!this.image.hasCt) return;
    const { level, width } = this.image.levels, hu = Math.max(WINDOW_SHARE * width, LEAST_WINDOW_HU);
    this.image.setLevels(level + hu * higher, width + hu * wider);
    this.windowed();
    this.changed();
  }

  tap(event, name, slice) {
    if (event.button !== 0 || event.shiftKey || this.dragging !== "cross") return;
    const place = this.placeAt(event, slice);
    this.set(place, name);
    this.picked(place, name);
  }

  key(event, name, slice) {
    const shift = SHIFTS[event.key];
    if (shift && event.shiftKey && !shift[2]) this.pan(-20 * shift[0], 20 * shift[1], slice);
    else if (shift) this.set(this.step(slice, shift, shift[2] && event.shiftKey ? FAST : 1), name);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / ZOOM, this.place);
    else if (event.key === "-") this.zoom(ZOOM, this.place);
    else if (event.key === "0") this.lookAt(this.place);
    else if (event.key === "Enter") this.picked([...this.place], name);
    else return;
    event.preventDefault();
  }
}
