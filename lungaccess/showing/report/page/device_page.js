// A page with the devices of a plan in its 3-D view: what of them is fitted, cut, named and measured.
import { AnatomyPage } from "./anatomy_page.js";
import { lineOf } from "./devices.js";
import { ballAround, sideOf } from "./orbit.js";
import { alongLine } from "./surfaces.js";
import { minus, mix, norm, unit } from "./vectors.js";

const NAMES = {
  scope: "Bronchoscope", outer: "Outer tube", middle: "Middle tube", inner: "Inner tube", needle: "Needle", target: "Target",
  aim: "Aim of the devices", measure: "Measured line",
};
// Of the scope so many points before its tip are in the view of the plan, and so much around all of it.
const SCOPE_POINTS = 16, AROUND_PLAN_MM = 12;
const NEAR_TARGET_MM = 25;

// It has
//   end: what is where at the end of the deployment that is followed, null without one; see motion.js;
//   target: LPS mm, null without one.
export class DevicePage extends AnatomyPage {
  // The line of tubes and needle at their end.
  get devices() {
    return this.end ? lineOf(this.end) : [];
  }

  // Name what can be fitted, target and devices beyond the scope, and these with the end of the scope; bring out what is near.
  fitToPlan() {
    const { end, devices, target } = this;
    this.scene.setFocus(end && devices);
    if (!end) return;
    for (const [name, scope] of [["target", []], ["plan", this.way]]) {
      const { centre, radius } = ballAround([...scope, ...devices, target]);
      this.orbit.setHome(name, centre, radius + AROUND_PLAN_MM);
    }
  }

  // The end of the scope that is in the view of the plan.
  get way() {
    return this.end.scope.slice(-SCOPE_POINTS);
  }

  // Look at the plan from the side from which it is seen long, or else at the target, or at the cross.
  lookAtPlan() {
    if (!this.orbit) return;
    const { devices } = this;
    if (!devices.length) this.orbit.setHome("plan", this.target || this.views.place, NEAR_TARGET_MM);
    this.orbit.home = this.orbit.homes.plan;
    if (devices.length) this.orbit.look(sideOf(devices));
    else this.orbit.comeHome();
  }

  cutThrough() {
    const { end, target } = this;
    if (!end) return target && { point: target, name: "the target" };
    const [line, name] = end.needle.length > 1 ? [end.needle, "the needle"] : [end.inner, "the tube"];
    const [first, last] = [line[0], line[line.length - 1]];
    return line.length > 1 ? { point: mix(first, last, 0.5), axis: unit(minus(last, first)), name } : null;
  }

  nameOf(hit) {
    return NAMES[hit.key] || super.nameOf(hit);
  }

  distancesOf(point) {
    const { end, target } = this, needle = end ? end.needle : [];
    return [
      ...(needle.length > 1 ? [`${alongLine(needle, point).awayMm.toFixed(1)} mm to the needle's axis`] : []),
      ...(target ? [`${norm(minus(point, target)).toFixed(1)} mm to the target`] : []),
    ];
  }

  alongMm(a, b) {
    const { devices } = this;
    return devices.length ? Math.abs(alongLine(devices, a).alongMm - alongLine(devices, b).alongMm) : null;
  }

  films() {
    return [{ key: "deployment", name: "the deployment" }];
  }

  filmAt(_kind, share) {
    this.player.position = share;
  }
}
