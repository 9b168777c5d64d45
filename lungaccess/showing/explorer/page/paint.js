// Masks mended by hand: strokes drawn in the slices, of which the server makes voxels, a new lung and a new plan.
import { byId } from "../report/anatomy_page.js";
import { cross } from "../report/vectors.js";
import { whatIf } from "./state.js";
import { errorWords } from "./widgets.js";

const MOST_POINTS = 300, INKS = { paint: "#FFD54A99", erase: "#FF6E6E99" };
const round = (point) => point.map((value) => Number(value.toFixed(2)));

export function connectPainting(page) {
  const box = byId("mend"), value = (name) => byId(`mend-${name}`).value;
  let stroke = null, other = null, changed = false;

  const say = (words) => (byId("mend-words").textContent = words);
  const radius = () => Number(value("radius")) || 2;

  // Draw the stroke until the voxels that come of it are there.
  function show(points) {
    const [first] = points || [], nearby = first && [[first[0] + 0.01, first[1] + 0.01, first[2] + 0.01]];
    page.stroke = points && { points: [...points, ...nearby.filter(() => points.length < 2)], radius: radius(), colour: INKS[value("tool")] || INKS.paint };
    page.redrawSlices();
  }

  async function send(points, normal, tool = value("tool")) {
    const { state } = page, asked = {
      tool, structure: value("structure"), points: points.map(round), radius_mm: radius(), level_hu: Number(value("level")) || 150,
      ...(normal && byId("mend-flat").checked ? { normal } : {}), what_if: whatIf(state.asked),
    };
    say("The masks are being changed…");
    const last = await page.asker.latest("paint", asked, async ({ image, size_ml: size }) => {
      changed = true;
      say(`${size.toFixed(2)} ml changed. The 3-D view shows them when this is closed.`);
      await page.takeFine(image);
    });
    if (last.answer === "superseded") return;
    show(null);
    if (last.answer === "error") say(errorWords(last.error));
    if (last.answer === "end") await page.renew();
  }

  for (const [name, slice] of Object.entries(page.slices)) {
    const { canvas } = slice;
    const isMine = (event) => event.target === canvas && box.open && event.button === 0 && !event.shiftKey;
    const listen = (kind, act) => canvas.parentElement.addEventListener(kind, act, { capture: true });
    listen("pointerdown", (event) => {
      if (!isMine(event)) return;
      event.stopPropagation();
      canvas.setPointerCapture(event.pointerId);
      stroke = { name, points: [page.views.placeAt(event, slice)] };
      show(stroke.points);
    });
    listen("pointermove", (event) => {
      if (!stroke || stroke.name !== name) return;
      event.stopPropagation();
      if (stroke.points.length < MOST_POINTS) stroke.points.push(page.views.placeAt(event, slice));
      show(stroke.points);
    });
    listen("pointerup", (event) => {
      if (!stroke || stroke.name !== name) return;
      event.stopPropagation();
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
  // The surfaces of the 3-D view are made anew with the page.
  box.addEventListener("toggle", () => !box.open && changed && location.reload());
}
