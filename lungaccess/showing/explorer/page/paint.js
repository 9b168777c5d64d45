// Masks mended by hand: strokes drawn in the slices, of which the server makes voxels, a new lung and a new plan.
import { byId } from "../report/structures.js";
import { add, cross } from "../report/vectors.js";
import { whatIf } from "./state.js";

const MOST_POINTS = 300, INKS = { paint: "#FFD54A99", erase: "#FF6E6E99" };
const round = (point) => point.map((value) => Number(value.toFixed(2)));

export function connectPainting(page) {
  const box = byId("mend"), value = (name) => byId(`mend-${name}`).value;
  let stroke = null, other = null, changed = false;

  const say = (words) => (byId("mend-words").textContent = words);
  const radius = () => Number(value("radius")) || 2;

  // Draw the stroke until the voxels that come of it are there.
  function show(points) {
    // A line needs two points.
    const line = points?.length === 1 ? [points[0], add(points[0], [0.01, 0.01, 0.01])] : points;
    page.stroke = line && { points: line, radius: radius(), colour: INKS[value("tool")] || INKS.paint };
    page.redrawSlices();
  }

  async function send(points, normal, tool = value("tool")) {
    const { state } = page, asked = {
      tool, structure: value("structure"), points: points.map(round), radius_mm: radius(), level_hu: Number(value("level")) || 150,
      ...(normal && byId("mend-flat").checked ? { normal } : {}), what_if: whatIf(state.asked),
    };
    say("The masks are being changed…");
    const { answer } = await page.asker.ask("paint", asked, async ({ image, size_ml: size }) => {
      changed = true;
      say(`${size.toFixed(2)} ml changed. The 3-D view shows them when this is closed.`);
      await page.takeFine(image);
    }, say);
    if (answer !== "superseded") show(null);
    if (answer === "end") await page.renew();
  }

  for (const [name, slice] of Object.entries(page.slices)) {
    const { canvas } = slice;
    const isMine = (event) => event.target === canvas && box.open && event.button === 0 && !event.shiftKey;
    // Before the slices hear of it: a stroke is drawn instead of what a drag does else.
    const listen = (kind, isWanted, act) => canvas.parentElement.addEventListener(kind, (event) => {
      if (!isWanted(event)) return;
      event.stopPropagation();
      act(event);
    }, { capture: true });
    const isDrawn = () => stroke?.name === name;
    listen("pointerdown", isMine, (event) => {
      canvas.setPointerCapture(event.pointerId);
      stroke = { name, points: [page.views.placeAt(event, slice)] };
      show(stroke.points);
    });
    listen("pointermove", isDrawn, (event) => {
      if (stroke.points.length < MOST_POINTS) stroke.points.push(page.views.placeAt(event, slice));
      show(stroke.points);
    });
    listen("pointerup", isDrawn, () => {
      const { points } = stroke, { right, up } = slice.plane;
      stroke = null;
      if (value("tool") !== "join") send(points, cross(right, up));
      else if (other) {
        send([other, points[0]], null);
        other = null;
      } else {
        [other] = points;
        say("Now click the other end of the gap, in any slice.");
      }
    });
  }

  byId("mend-undo").addEventListener("click", () => send([page.place], null, "undo"));
  byId("mend-tool").addEventListener("change", () => {
    other = null;
    say("");
  });
  // The masks are read before the first stroke.  The surfaces of the 3-D view are made anew with the page.
  const open = () => page.asker.ask("paint", { tool: "open", what_if: whatIf(page.state.asked) }, () => {}, say);
  box.addEventListener("toggle", () => (box.open ? open() : changed && location.reload()));
}
