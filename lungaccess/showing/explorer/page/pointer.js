// What a click in the 3-D view chooses, and how exit and scope tip are dragged.
import { rayThrough } from "../report/picking.js";
import { add, dot, minus, norm, times } from "../report/vectors.js";
import { leastOf, lpsText } from "./widgets.js";

const HANDLE_PX = 14;

export function connectPointer(page) {
  const { scene, orbit } = page, canvas = scene.canvas;
  let dragged = null;

  const place = ({ offsetX, offsetY }) => [offsetX, offsetY];
  const near = (point, at) => {
    const seen = scene.project(point);
    return seen ? Math.hypot(seen[0] - at[0], seen[1] - at[1]) : Infinity;
  };
  const nearestExit = (at) => leastOf([...page.exits.places.keys()], (n) => near(page.exits.places[n], at));

  // Return what can be dragged at a place: the chosen exit or the tip of the scope, whichever is nearer to the pointer.
  // While lengths are measured nothing can, so that a press on a device measures from it.
  const handleAt = (at) => {
    if (!scene.view || page.tools.measuring) return null;
    const { exits, tips, plan, state: { asked } } = page;
    const handles = {
      exit: exits?.places[exits.numberOf(asked.exit)] ?? (exits?.count ? plan?.exit_lps : null),
      tip: tips?.place(asked.tip) ?? (tips && plan?.scope_tip_lps),
    };
    const away = (kind) => (handles[kind] ? near(handles[kind], at) : Infinity), found = leastOf(Object.keys(handles), away);
    return found && away(found) <= HANDLE_PX ? found : null;
  };

  const dragTo = (at) => {
    const { exits, tips } = page, isExit = dragged.kind === "exit";
    const found = isExit ? nearestExit(at) : leastOf(tips.usable, (n) => near(tips.place(n), at));
    dragged.value = isExit ? exits.entries[found] : found;
    page.tools.say(isExit ? `Exit ${found + 1}: let go to plan from it` : "Scope tip: let go to plan from there");
    page.preview(isExit ? exits.places[found] : tips.place(found));
  };

  // Before the camera hears of it: a handle moves instead of the view.
  canvas.parentElement.addEventListener("pointerdown", (event) => {
    if (event.target !== canvas || event.button !== 0) return;
    const kind = event.shiftKey ? null : handleAt(place(event));
    if (!kind) return;
    dragged = { kind, value: null };
    canvas.setPointerCapture(event.pointerId);
    event.stopPropagation();
  }, { capture: true });

  canvas.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (dragged) dragTo(at);
    else if (!event.buttons) canvas.style.cursor = handleAt(at) ? "move" : "";
  });

  const letGo = (event) => {
    if (!dragged) return;
    const { kind, value } = dragged;
    dragged = null;
    page.preview(null);
    if (event.type === "pointercancel") return;
    if (value === null) page.pickAt(place(event));
    else page.choose({ [kind]: value });
  };
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, letGo);

  const { clicked } = orbit;
  orbit.clicked = (event) => {
    const { measuring } = page.tools;
    clicked(event);
    if (!measuring && event.button === 0) page.pickAt(place(event));
  };

  page.preview = (point) => {
    scene.setPoints("preview", point ? { places: point, colours: [1, 1, 1], radii: 2.4 } : null);
    page.redrawScene();
  };

  // Choose what is at a place of the view: an exit, a nodule, or a place in the plane through the cross.
  page.pickAt = (at) => {
    if (!scene.view) return undefined;
    const { exits } = page, exit = exits && nearestExit(at);
    if (exit !== null && near(exits.places[exit], at) <= HANDLE_PX / 2) return page.choose({ exit: exits.entries[exit] });
    const found = scene.pick(...at, { pickable: ["nodule"] })?.hits.find(({ key }) => key === "nodule");
    const nodules = page.facts.targets.filter(({ text }) => found && text.startsWith("nodule "));
    const nodule = leastOf(nodules, ({ lps_mm: place }) => norm(minus(place, found.point)));
    if (nodule) return page.choose({ target: nodule.text });
    const { eye, forward } = orbit.camera();
    const [x, y] = [(2 * at[0]) / canvas.clientWidth - 1, 1 - (2 * at[1]) / canvas.clientHeight];
    const ray = rayThrough(scene, x, y);
    const depth = dot(minus(page.place, eye), forward) / dot(ray, forward);
    page.moveTo(add(eye, times(ray, depth)));
    return page.choose({ target: lpsText(page.place) });
  };
}
