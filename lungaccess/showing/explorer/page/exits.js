// The feasible exits of the target: painted in 3-D and in the slices, listed, chosen.
import { VIRIDIS } from "../report/colours.js";
import { made } from "../report/structures.js";
import { point, ramp, rgb } from "../report/vectors.js";
import { button, mm } from "./widgets.js";

// Without its darkest end.
const RAMP = VIRIDIS.slice(1);
const RADIUS_MM = 1.1, CHOSEN_MM = 1.8, MOST_LISTED = 12;
const CHOSEN = rgb("#FFFFFF");

export class Exits {
  constructor(answer) {
    const { arrays } = answer;
    this.answer = answer;
    this.entries = arrays.entry;
    this.tips = arrays.tip;
    this.places = Array.from({ length: arrays.entry.length }, (_, n) => point(arrays.points, n));
    this.count = this.places.length;
  }

  // Return a share from 0, worst, to 1, best, for each exit, by "cost" or "clearance".
  shares(by) {
    const values = Array.from(by === "cost" ? this.answer.arrays.cost : this.answer.arrays.clearance_mm);
    const low = Math.min(...values), high = Math.max(...values);
    const share = (value) => (high > low ? (value - low) / (high - low) : 1);
    return values.map((value) => (by === "cost" ? 1 - share(value) : share(value)));
  }

  // Return the points of the 3-D view; the chosen one is white and larger.
  points(by, chosen) {
    const shares = this.shares(by);
    const colours = shares.map((share, n) => (n === chosen ? CHOSEN : ramp(RAMP, share)));
    const radii = shares.map((_, n) => (n === chosen ? CHOSEN_MM : RADIUS_MM));
    return { places: this.places.flat(), colours: colours.flat(), radii };
  }

  // Return the number of the exit with an entry of the atlas, -1 for none.
  numberOf(entry) {
    return entry === null ? -1 : this.entries.indexOf(entry);
  }

  // Say in words how many there are.
  words() {
    const { in_workspace: held, tried, complete, blocked } = this.answer;
    const more = complete ? "" : ` (${tried} of ${held} positions of the tubes tried so far)`;
    if (this.count) return `${this.count} ${this.count === 1 ? "place" : "places"} to leave the airway with one clear arc${more}`;
    if (!held) return "From no position of the tubes does the needle get as far as the target in one arc";
    const stopped = Object.entries(blocked).sort((a, b) => b[1] - a[1]).map(([name, count]) => `${name} stops ${count}`);
    return `No single arc is clear from ${held} positions of the tubes${more}: ${stopped.join(", ")}`;
  }

  // List them in a table body, the least costly first; choose receives an entry.
  list(body, chosen, choose) {
    const { clearance_mm: clearance, length_mm: length, count } = this.answer.arrays;
    const rows = this.places.slice(0, MOST_LISTED).map((_, n) => made("tr", {},
      made("th", { scope: "row" }, button(`${n + 1}`, `Plan from exit ${n + 1}`, () => choose(this.entries[n]),
        { ariaPressed: String(n === chosen) })),
      ...[mm(clearance[n]), mm(length[n], 0), String(count[n])].map((text) => made("td", {}, text))));
    body.replaceChildren(...rows);
    return this.places.length - rows.length;
  }
}
