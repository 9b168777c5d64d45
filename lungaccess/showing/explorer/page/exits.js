// The feasible exits of the target and the places of the scope, as the atlas has them: painted, listed, chosen.
import { VIRIDIS } from "../report/colours.js";
import { minus, norm, point, ramp, rgb } from "../report/vectors.js";
import { button, leastOf, mm } from "./widgets.js";

// Without its darkest end.
const RAMP = VIRIDIS.slice(1);
const RADIUS_MM = 1.1, CHOSEN_MM = 1.8, MOST_LISTED = 12;
const CHOSEN = rgb("#FFFFFF");
const NEXT_MM = 6, STEP_MM = 2;

export class Exits {
  constructor(answer) {
    const { arrays } = answer;
    Object.assign(this, { answer, entries: arrays.entry, tips: arrays.tip, count: arrays.entry.length });
    this.unlisted = this.count > MOST_LISTED ? `${this.count - MOST_LISTED} more are painted` : "";
    this.places = Array.from(arrays.entry, (_, n) => point(arrays.points, n));
  }

  // Return the points of the 3-D view, coloured from worst to best by "cost" or "clearance"; the chosen one is white and larger.
  points(by, chosen) {
    const { cost, clearance_mm: clearance } = this.answer.arrays;
    const values = Array.from(by === "cost" ? cost.map((value) => -value) : clearance);
    const low = Math.min(...values), high = Math.max(...values), share = (value) => (high > low ? (value - low) / (high - low) : 1);
    const colours = values.map((value, n) => (n === chosen ? CHOSEN : ramp(RAMP, share(value))));
    return { places: this.places.flat(), colours: colours.flat(), radii: values.map((_, n) => (n === chosen ? CHOSEN_MM : RADIUS_MM)) };
  }

  // Return the number of the exit with an entry of the atlas, -1 for none.
  numberOf(entry) {
    return this.entries.indexOf(entry);
  }

  // Return the rows of a table, the least costly first; choose receives an entry.
  rows(chosen, choose) {
    const { clearance_mm: clearance, length_mm: length, count } = this.answer.arrays;
    return this.places.slice(0, MOST_LISTED).map((_, n) => [
      button(`${n + 1}`, `Plan from exit ${n + 1}`, () => choose(this.entries[n]), { ariaPressed: String(n === chosen) }),
      mm(clearance[n]), mm(length[n], 0), String(count[n]),
    ]);
  }
}

export class Tips {
  constructor({ arrays: { tips, turned, depth_mm: depth, deployments } }) {
    Object.assign(this, { tips, depth });
    // Those along the axis of the airway from which something can be deployed.
    this.usable = [...turned.keys()].filter((n) => !turned[n] && deployments[n]);
  }

  // Return the place of a tip, null where the atlas has none of that number.
  place(number) {
    return number in this.depth ? point(this.tips, 2 * number) : null;
  }

  nearest(place) {
    return leastOf(this.usable, (n) => norm(minus(this.place(n), place)));
  }

  // Return the next tip towards the trachea (-1) or away from it (1), where the airway forks the one nearer to a point.
  next(from, way, towards) {
    const start = this.place(from);
    return start && leastOf(this.usable, (n) => {
      const deeper = way * (this.depth[n] - this.depth[from]), place = this.place(n), away = norm(minus(place, start));
      if (deeper <= 0 || away > NEXT_MM || Math.abs(away - deeper) > STEP_MM) return Infinity;
      return Math.abs(deeper - STEP_MM) + (towards ? 0.2 * norm(minus(place, towards)) : 0);
    });
  }
}
