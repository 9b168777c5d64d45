// The places where the tip of the scope can stand, as the atlas has them.
import { minus, norm, point } from "../report/vectors.js";
import { leastOf } from "./widgets.js";

const NEXT_MM = 6, STEP_MM = 2;

export class Tips {
  constructor({ arrays: { tips, turned, depth_mm: depth, deployments } }) {
    Object.assign(this, { tips, depth, count: turned.length });
    // Those along the axis of the airway from which something can be deployed.
    this.usable = [...turned.keys()].filter((n) => !turned[n] && deployments[n]);
  }

  place(number) {
    return number === null || number === undefined || number >= this.count ? null : point(this.tips, 2 * number);
  }

  nearest(place) {
    return leastOf(this.usable, (n) => norm(minus(this.place(n), place)));
  }

  // Return the next tip towards the trachea (-1) or away from it (1), where the airway forks the one nearer to a point.
  next(from, way, towards) {
    if (from === null) return null;
    const start = this.place(from);
    return leastOf(this.usable, (n) => {
      const deeper = way * (this.depth[n] - this.depth[from]), place = this.place(n), away = norm(minus(place, start));
      if (deeper <= 0 || away > NEXT_MM || Math.abs(away - deeper) > STEP_MM) return Infinity;
      return Math.abs(deeper - STEP_MM) + (towards ? 0.2 * norm(minus(place, towards)) : 0);
    });
  }
}
