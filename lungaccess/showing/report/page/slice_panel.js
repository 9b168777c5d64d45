// The controls of slices (slices.html): field, window, what a drag does, opacities, and what is under the pointer.
import { byId, made, swatch } from "./structures.js";
import { minus, norm } from "./vectors.js";

export class SlicePanel {
  // said(place): further words about a place, such as its distance from the target.
  constructor(views, said = () => []) {
    Object.assign(this, { views, said });
    const { image } = views, on = (id, act) => byId(id).addEventListener("change", ({ target }) => act(target));
    byId("ct-controls").hidden = !image.hasCt;
    if (!image.hasCt) byId("drag").querySelector("[value=window]").remove();
    on("drag", ({ value }) => this.chooseDrag(value));
    on("field", ({ value }) => value && views.setWidth(Number(value)));
    on("window", ({ value }) => this.changeWindow(() => image.setWindow(value)));
    for (const id of ["window-level", "window-width"]) {
      on(id, () => this.changeWindow(() => {
        const [level, width] = [byId("window-level"), byId("window-width")].map((field) => Number(field.value));
        if (Number.isFinite(level) && width > 0) image.setLevels(level, width);
      }));
    }
    on("tint", ({ checked }) => {
      image.tint = checked;
      views.changed();
    });
    for (const structure of image.structures()) this.addOpacity(structure);
    this.showWindow();
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
    byId("window").value = image.windowName || "free";
    byId("window-level").value = Math.round(level);
    byId("window-width").value = Math.round(width);
  }

  // Write the width of the pictures into its field, and say what is at the pointer or the cross.
  show() {
    const field = byId("field"), { widthMm } = this.views, known = [...field.options].find((option) => Number(option.value) === widthMm);
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
    byId("opacities").append(made("li", {}, made("label", {}, swatch(colour), name, slider)));
  }

  // Say what is at a place: of the pointer, or of the cross when there is none.
  describe(place = this.pointer && this.pointer.place, name = this.pointer && this.pointer.name) {
    this.pointer = place ? { place, name } : null;
    const { views } = this, { image } = views, at = place || views.place;
    const hu = name && place ? views.slices[name].huAt(at) : image.huAt(at), voxel = image.grid.voxel(image.inMasks(at));
    byId("under-pointer").textContent = [
      `${place ? "Pointer" : "Cross"}: LPS ${at.map((value) => value.toFixed(1)).join(", ")} mm`,
      voxel ? `voxel ${voxel.join(", ")}` : "beyond the image",
      image.structureAt(at),
      ...(hu === null ? [] : [`${hu.toFixed(0)} HU`]),
      ...(place ? [`${norm(minus(place, views.place)).toFixed(1)} mm from the cross`] : []),
      ...this.said(at),
    ].join(" · ");
  }
}
