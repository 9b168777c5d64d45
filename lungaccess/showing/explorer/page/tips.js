// The places where the tip of the scope can stand, as the atlas has them.
import { minus, norm, point } from "../report/vectors.js";

const NEXT_MM = 6, STEP_MM = 2;

export class Tips {
  constructor({ arrays: { tips, turned, depth_mm: depth, deployments } }) {
    this.count = turned.length;
    this.tips = tips;
    this.turned = turned;
    this.depth = depth;
    this.deployments = deployments;
  }

  place(number) {
    return number === null || number === undefined || number >= this.count ? null : point(this.tips, 2 * number);
  }

  // Return a number if there is such a tip, else null.
  chosen(number) {
    return this.place(number) === null ? null : number;
  }

  // Return the tip nearest to a point, of those along the axis of the airway.
  nearest(place) {
    let least = Infinity, found = null;
    for (let n = 0; n < this.count; n++) {
      if (this.turned[n] || !this.deployments[n]) continue;
      const away = norm(minus(this.place(n), place));
      if (away < least) [least, found] = [away, n];
    }
    return found;
  }

  // Return the next tip towards the trachea (-1) or away from it (1), where the airway forks the one nearer to a point.
  next(from, way, towards) {
    if (from === null) return null;
    const start = this.place(from);
    let best = null, least = Infinity;
    for (let n = 0; n < this.count; n++) {
      if (this.turned[n] || !this.deployments[n] || n === from) continue;
      const deeper = way * (this.depth[n] - this.depth[from]);
      const place = this.place(n), away = norm(minus(place, start));
      if (deeper <= 0 || away > NEXT_MM || Math.abs(away - deeper) > STEP_MM) continue;
      const cost = Math.abs(deeper - STEP_MM) + (towards ? 0.2 * norm(minus(place, towards)) : 0);
      if (cost < least) [least, best] = [cost, n];
    }
    return best;
  }
}
