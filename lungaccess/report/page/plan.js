// The page of a plan.
import { AnatomyPage, byId, openPage } from "./anatomy_page.js";
import { Bronchoscopy } from "./bronchoscopy.js";
import { lineChart } from "./charts.js";
import { reportData, unpack } from "./decode.js";
import { Motion, STAGES } from "./motion.js";
import { planeAcross, STANDARD, VoxelImage } from "./slices.js";
import { Solids } from "./solids.js";
import { addSwitch } from "./structures.js";
import { rgb } from "./vectors.js";

const DEVICES = [
  { key: "scope", name: "Bronchoscope", colour: "#0072B2", shown: true },
  { key: "tubes", name: "Tubes", colour: "#E69F00", shown: true },
  { key: "needle", name: "Needle, coloured by clearance", colour: "linear-gradient(90deg, #D81B60, #56B4E9)", shown: true },
  { key: "target", name: "Target", colour: "#39E0B0", shown: true },
];
const OUTER = "#E69F00", MIDDLE = "#EDB42E", INNER = "#F4C95D", OTHER = "#8A8F98", NEEDLE_INK = "#D81B60";
const CHART = {
  airway: ["airway wall", "#3A9BD5", ""], vessel: ["vessel", "#D81B60", "9 4"],
  pleura: ["pleura", "#B8860B", "3 4"], fissure: ["fissure", "#785EF0", "12 4 3 4"],
};
const COSTS = [["#0072B2", ""], ["#D55E00", "8 4"]];
const PLAY_S = 14;
const LEAST_WIDTH = 0.0016;

class PlanPage extends AnatomyPage {
  constructor(data) {
    super(data);
    this.slider = byId("position");
    this.shown = Object.fromEntries(DEVICES.map(({ key, shown }) => [key, shown]));
    this.cursors = [];
    this.playing = null;
  }

  async open() {
    this.motions = await Promise.all(this.data.plans.map((plan) => Motion.of(plan)));
    this.shownPlans = this.motions.map((_, n) => n === 0);
    this.followed = 0;
    this.listSwitches();
    this.connectControls();
    if (await this.openScene(distanceOfAll)) this.addTarget();
    this.image = await VoxelImage.of(this.data);
    this.openSlices([...Object.keys(STANDARD), "across"]);
    byId("ct-controls").hidden = !this.image.hasCt;
    await this.drawCharts();
    this.draw();
  }

  get motion() {
    return this.motions[this.followed];
  }

  addTarget() {
    const target = this.data.plans[0].target_lps;
    byId("view-target").addEventListener("click", () => this.orbit.approach(target, 170));
    this.bronchoscopy = new Bronchoscopy(this.scene, byId("inside"), byId("inside-place"));
    this.targetBall = new Solids();
    this.targetBall.ball(target, 1.6, rgb("#39E0B0"));
  }

  listSwitches() {
    const hasNeedle = this.motions.some((motion) => motion.hasNeedle);
    for (const element of document.querySelectorAll("[data-needle]")) element.hidden = !hasNeedle;
    for (const device of DEVICES.filter(({ key }) => key !== "needle" || hasNeedle)) {
      addSwitch(byId("devices"), device, (on) => {
        this.shown[device.key] = on;
        this.redraw();
      });
    }
    this.listStructures();
    this.data.plans.forEach((plan, n) => {
      const name = `${plan.name}${plan.accepted ? "" : " (refused)"}`;
      addSwitch(byId("plans"), { key: `plan-${n}`, name, colour: n ? OTHER : NEEDLE_INK, shown: n === 0 }, (on) => {
        this.shownPlans[n] = on;
        this.redraw();
      });
      byId("followed").append(new Option(name, n));
    });
    byId("followed-row").hidden = this.data.plans.length < 2;
    byId("followed").addEventListener("change", async (event) => {
      this.followed = Number(event.target.value);
      await this.drawCharts();
      this.redraw();
    });
  }

  connectControls() {
    this.slider.addEventListener("input", () => {
      this.stop();
      this.redraw();
    });
    byId("play").addEventListener("click", () => (this.playing === null ? this.play() : this.stop()));
    for (const button of document.querySelectorAll("button[data-stage]")) {
      button.addEventListener("click", () => {
        this.stop();
        this.moveTo(this.motion.starts[Number(button.dataset.stage)]);
      });
    }
    for (const id of ["field", "window", "tint"]) byId(id).addEventListener("change", () => this.redraw());
  }

  moveTo(position) {
    this.slider.value = Math.round(1000 * position);
    this.redraw();
  }

  play() {
    const from = Number(this.slider.value) >= 1000 ? 0 : Number(this.slider.value) / 1000;
    const began = performance.now();
    const step = (now) => {
      const position = Math.min(from + (now - began) / (1000 * PLAY_S), 1);
      this.slider.value = 1000 * position;
      this.draw();
      if (position >= 1) this.stop();
      else if (this.playing !== null) this.playing = requestAnimationFrame(step);
    };
    byId("play").textContent = "Pause";
    this.playing = requestAnimationFrame(step);
  }

  stop() {
    if (this.playing !== null) cancelAnimationFrame(this.playing);
    this.playing = null;
    byId("play").textContent = "Play";
  }

  draw() {
    const state = this.motion.at(Number(this.slider.value) / 1000);
    this.state = state;
    const words = this.motion.words(state);
    this.slider.setAttribute("aria-valuetext", words);
    byId("position-words").textContent = words;
    for (const button of document.querySelectorAll("button[data-stage]")) {
      button.setAttribute("aria-pressed", String(Number(button.dataset.stage) === state.stage));
    }
    if (this.scene) this.drawDevices(state);
    if (this.slices) this.drawSlices(state);
    for (const move of this.cursors) move(this.motion.alongMm(state));
  }

  drawDevices(state) {
    const { scene, shown } = this;
    const radius = thickened(this.motion.plan.radius_mm, this.orbit.distance);
    const followed = this.shownPlans[this.followed];
    const put = (name, on, fill) => {
      const solids = new Solids();
      if (on) fill(solids);
      scene.setSolids(name, solids);
    };
    put("scope", followed && shown.scope, (s) => s.tube(state.scope, radius.scope, rgb("#0072B2")));
    put("outer", followed && shown.tubes, (s) => s.tube(state.outer, radius.outer, rgb(OUTER)));
    put("middle", followed && shown.tubes, (s) => s.tube(state.middle, radius.middle, rgb(MIDDLE)));
    put("inner", followed && shown.tubes, (s) => s.tube(state.inner, radius.inner, rgb(INNER)));
    put("needle", followed && shown.needle, (s) => s.tube(state.needle, radius.needle, state.needleColours));
    put("others", true, (s) => this.otherPlans(s));
    scene.setSolids("target", shown.target ? this.targetBall : null);
    scene.fit();
    this.bronchoscopy.draw(state, this.motion);
    this.drawScene();
  }

  otherPlans(solids) {
    this.motions.forEach((motion, n) => {
      if (n === this.followed || !this.shownPlans[n]) return;
      const end = motion.at(1);
      const radius = thickened(motion.plan.radius_mm, this.orbit.distance);
      if (this.shown.scope) solids.tube(end.scope, 0.6 * radius.scope, rgb(OTHER));
      if (this.shown.tubes) solids.tube([...end.outer, ...end.middle, ...end.inner], 0.8 * radius.inner, rgb("#C9A24A"));
      if (this.shown.needle) solids.tube(end.needle, 0.8 * radius.needle, end.needleColours);
    });
  }

  drawSlices(state) {
    const { radius_mm: radius, target_lps: target } = this.motion.plan;
    this.image.tint = byId("tint").checked;
    this.image.setWindow(byId("window").value);
    const lines = [
      this.shown.scope && { points: state.scope, radius: radius.scope, colour: "#3FA9E8" },
      this.shown.tubes && { points: state.outer, radius: radius.outer, colour: OUTER },
      this.shown.tubes && { points: state.middle, radius: radius.middle, colour: MIDDLE },
      this.shown.tubes && { points: state.inner, radius: radius.inner, colour: INNER },
      this.shown.needle && { points: state.needle, radius: radius.needle, colour: "#FF4081" },
    ].filter((line) => line && line.points.length > 1);
    const marks = { lines, target: this.shown.target ? target : null, cross: state.tip };
    const width = Number(byId("field").value);
    for (const [name, plane] of Object.entries(STANDARD)) this.slices[name].draw(plane, state.tip, width, marks);
    this.slices.across.draw(planeAcross(state.direction), state.tip, Math.min(width, 60), marks);
    byId("slice-place").textContent = `Through the foremost tip, at LPS ${state.tip.map((v) => v.toFixed(1)).join(", ")} mm.`;
  }

  async drawCharts() {
    const { profile, costs, objective } = this.motion.plan;
    const along = await unpack(profile.arc_length_mm);
    const x = { name: "mm beyond the tip of the scope" };
    const hasNeedle = this.motion.hasNeedle;
    const marks = [{ at: profile.exit_mm, name: "exit" }, ...(hasNeedle ? [{ at: profile.tube_mm, name: "needle" }] : [])];
    const clearances = await Promise.all(Object.entries(profile.clearance_mm).map(async ([key, packed]) => {
      const allowed = key === "fissure" && !profile.fissures_are_obstacles ? " (may be crossed)" : "";
      return { name: CHART[key][0] + allowed, colour: CHART[key][1], dash: CHART[key][2], xs: along, ys: await unpack(packed) };
    }));
    const required = { name: "required", colour: "currentColor", xs: along, ys: await unpack(profile.required_mm), stairs: true, width: 1.8 };
    const cost = await Promise.all(Object.entries(profile.cost).map(async ([key, packed], n) => ({
      name: key === "cost_map" ? "cost map" : "1/clearance", colour: COSTS[n][0], dash: COSTS[n][1],
      xs: await unpack(profile.cost_mm), ys: await unpack(packed),
    })));
    const bend = { name: "curvature", colour: "#0072B2", xs: along, ys: await unpack(profile.curvature_per_mm), stairs: true };
    const limit = { name: "limit of the needle", colour: "currentColor", dash: "6 4", width: 1.6,
      xs: [profile.tube_mm, along[along.length - 1]], ys: [profile.most_curvature_per_mm, profile.most_curvature_per_mm] };
    this.cursors = [
      lineChart(byId("chart-clearance"), {
        x, y: { name: "mm" }, series: [...clearances, required], top: profile.cap_mm, marks,
        spans: [{ from: 0, to: Math.max(profile.exempt_to_mm, 0) }],
      }),
      lineChart(byId("chart-curvature"), { x, y: { name: "1/mm" }, series: hasNeedle ? [bend, limit] : [bend], marks }),
      lineChart(byId("chart-cost"), { x, y: { name: "cost so far" }, series: cost }),
    ];
    byId("cost-total").textContent = `In all ${costs[objective].toPrecision(4)} (${this.motion.plan.objective_words}, as the plan states).`;
    const history = this.data.cost_over_time;
    byId("chart-history").hidden = history.length < 2;
    if (history.length < 2) return;
    const ys = history.map(([, value]) => value);
    lineChart(byId("chart-history"), {
      x: { name: "planning time, s" }, y: { name: this.data.made_small, from: Math.min(...ys) * 0.98 }, top: Math.max(...ys) * 1.02,
      series: [{ name: "best plan so far", colour: "#0072B2", xs: history.map(([s]) => s), ys, stairs: true }],
    });
  }

  // What a test may read; docs/how_to/report.md names the fields.
  report() {
    const { state } = this;
    return {
      ...super.report(),
      plan: this.followed, plans: this.shownPlans, position: state.position, stage: STAGES[state.stage],
      scope_mm: state.scopeMm, outer_mm: state.outerMm, inner_mm: state.innerMm, needle_mm: state.needleMm,
      tip_lps: state.tip, needle_lps: state.needle, camera: state.camera, devices: { ...this.shown },
      solids: this.scene ? Object.fromEntries([...this.scene.solids].map(([key, s]) => [key, s.count / 3])) : {},
      view: this.orbit ? { yaw: this.orbit.yaw, pitch: this.orbit.pitch, distance: this.orbit.distance, edges: this.orbit.edges() } : null,
    };
  }
}

// Return how far away the whole lung is seen at once, by its size in mm.
function distanceOfAll(size) {
  return 1.05 * Math.max(...size) / Math.tan((15 * Math.PI) / 180) / 2 + size[1] / 2;
}

// Return radii that can be seen from a distance.
function thickened(radius, distance) {
  const least = LEAST_WIDTH * distance;
  return Object.fromEntries(Object.entries(radius).map(([key, mm]) => [key, Math.max(mm, least)]));
}

openPage(new PlanPage(reportData()));
