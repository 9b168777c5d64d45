// The controls of slices (slices.html): field, window, what a drag does, opacities, and what is under the pointer.
import { made, swatch } from "./structures.js";
import { minus, norm } from "./vectors.js";

// Connects the controls with slices.
export class SlicePanel {
  // said(place): further words about a place, such as its distance from the target.
  constructor(root, views, said = () => []) {
    Object.assign(this, { views, said });
    this.find = (id) => root.querySelector(`#${id}`);
    const { image } = views;
    this.find("ct-controls").hidden = !image.hasCt;
    for (const name of ["cross", "window", "pan"]) if (name !== "window" || image.hasCt) this.addDrag(name);
    this.find("drag").addEventListener("change", () => this.chooseDrag(this.find("drag").value));
    this.find("field").addEventListener("change", () => {
      const mm = Number(this.find("field").value);
      if (mm) views.setWidth(mm);
    });
    this.find("window").addEventListener("change", () => this.changeWindow(() => image.setWindow(this.find("window").value)));
    for (const id of ["window-level", "window-width"]) {
      this.find(id).addEventListener("change", () => this.changeWindow(() => {
        const [level, width] = [this.find("window-level"), this.find("window-width")].map((field) => Number(field.value));
        if (Number.isFinite(level) && width > 0) image.setLevels(level, width);
      }));
    }
    this.find("tint").addEventListener("change", () => {
      image.tint = this.find("tint").checked;
      views.changed();
    });
    for (const structure of image.structures()) this.addOpacity(structure);
    this.showWindow();
  }

  addDrag(name) {
    this.find("drag").append(new Option({ cross: "the cross", window: "the window", pan: "the pictures" }[name], name));
  }

  chooseDrag(kind) {
    this.views.dragging = kind;
    for (const { canvas } of Object.values(this.views.slices)) canvas.classList.toggle("held", kind !== "cross");
  }

  changeWindow(change) {
    change();
    this.showWindow();
    this.views.changed();
  }

  // Write the window into its fields.
  showWindow() {
    const { image } = this.views, { level, width } = image.levels;
    this.find("window").value = image.windowName || "free";
    this.find("window-level").value = Math.round(level);
    this.find("window-width").value = Math.round(width);
  }

  // Write the width of the pictures into its field, and say what is at the pointer or the cross.
  show() {
    const field = this.find("field"), { widthMm } = this.views, known = [...field.options].find((option) => Number(option.value) === widthMm);
    const free = field.querySelector("option[value='']");
    free.textContent = known ? "other" : `${widthMm.toFixed(0)} mm`;
    field.value = known ? known.value : "";
    this.describe();
  }

  addOpacity({ name, colour, opacity }) {
    const slider = made("input", { type: "range", min: 0, max: 100, step: 5, value: Math.round(100 * opacity), "data-structure": name });
    const say = () => (slider.ariaValueText = `${slider.value} %`);
    say();
    slider.addEventListener("input", () => {
      say();
      this.views.image.setOpacity(name, Number(slider.value) / 100);
      this.views.changed();
    });
    this.find("opacities").append(made("li", {}, made("label", {}, swatch(colour), name, slider)));
  }

  // Say what is at a place: of the pointer, or of the cross when there is none.
  describe(place = this.pointer && this.pointer.place, name = this.pointer && this.pointer.name) {
    this.pointer = place ? { place, name } : null;
    const { views } = this, { image } = views, at = place || views.place;
    const hu = name && place ? views.slices[name].huAt(at) : image.huAt(at), voxel = image.grid.voxel(image.inMasks(at));
    this.find("under-pointer").textContent = [
      `${place ? "Pointer" : "Cross"}: LPS ${at.map((value) => value.toFixed(1)).join(", ")} mm`,
      voxel ? `voxel ${voxel.join(", ")}` : "beyond the image",
      image.structureAt(at),
      ...(hu === null ? [] : [`${hu.toFixed(0)} HU`]),
      ...(place ? [`${norm(minus(place, views.place)).toFixed(1)} mm from the cross`] : []),
      ...this.said(at),
    ].join(" · ");
  }
}
