// The page of a plan.
import { openPage } from "./anatomy_page.js";
import { Breath } from "./breath.js";
import { bifurcationsAhead, Bronchoscopy, pausesOf } from "./bronchoscopy.js";
import { planStyle } from "./colours.js";
import { reportData } from "./decode.js";
import { DevicePage } from "./device_page.js";
import { deviceLines, lineOf, showBall, showDevices, showOther } from "./devices.js";
import { Motion, STAGES } from "./motion.js";
import { bendOf, planeAcross, planeAlong, STANDARD } from "./slices.js";
import { Animated, Player } from "./player.js";
import { addSwitch, byId } from "./structures.js";
import { alongLine } from "./surfaces.js";
import { TipSection } from "./tip_section.js";
import { cross, dot, minus, mix, norm } from "./vectors.js";
import { VoxelImage } from "./voxel_image.js";

const BREATH_S = 5;
const MOST_ACROSS_MM = 60;
const AIM_MM = 1.1, ABOVE_CARINA_MM = 30;

class PlanPage extends DevicePage {
  constructor(data) {
    super(data);
    this.player = new Player(this, () => (byId("pause").checked ? pausesOf(this.motion) : []));
    this.shown = Object.fromEntries([...byId("devices").querySelectorAll("input")].map((box) => [box.dataset.key, box.checked]));
    this.phase = 0;
    this.exhaling = false;
  }

  async open() {
    if (this.data.breath) {
      this.breath = await Breath.of(this.data.breath);
      this.phase = this.breath.masksPhase;
    }
    this.motions = await Promise.all(this.data.plans.map((plan) => Motion.of(plan)));
    this.shownPlans = this.motions.map((_, n) => n < this.data.passes);
    this.followed = 0;
    this.listSwitches();
    this.connectControls();
    if (await this.openScene()) {
      this.bronchoscopy = new Bronchoscopy(this.scene, byId("inside"), byId("inside-place"), byId("inside-prompt"));
      this.fitToPlan();
      this.lookAtPlan();
    }
    this.image = await VoxelImage.of(this.data);
    this.image.breath = this.breath;
    this.sections = await Promise.all(this.data.plans.map(({ scope }) => TipSection.of(scope)));
    this.openSlices([...Object.keys(STANDARD), "across", "along"]);
    this.linkSlices({ placed: () => this.follow(false) });
    byId("along").value = this.motion.hasNeedle ? "needle" : "scope";
    this.draw();
  }

  get motion() {
    return this.motions[this.followed];
  }

  // In the phase of the breath.
  get end() {
    return this.stateOf(this.followed, 1);
  }

  // The scope from a little above the carina on: the whole way.
  get way() {
    const { scope } = this.end, wanted = this.motion.plan.scope.from_carina_mm + ABOVE_CARINA_MM;
    let first = scope.length - 1, mm = 0;
    for (; first > 0 && mm < wanted; first--) mm += norm(minus(scope[first], scope[first - 1]));
    return scope.slice(first);
  }

  nameOf(hit) {
    const [, number] = hit.key.split("plan ");
    return number ? this.data.plans[Number(number)].name : super.nameOf(hit);
  }

  // The numbers of the plans where several are shown, each at another place of its devices.
  labels() {
    const shown = this.motions.map((_, n) => n).filter((n) => this.shownPlans[n]);
    if (shown.length < 2) return [];
    return shown.map((n, k) => {
      const end = this.stateOf(n, 1), line = end.needle.length > 1 ? end.needle : end.inner;
      const at = Math.round((line.length - 1) * (0.2 + (0.75 * k) / (shown.length - 1)));
      return { text: this.data.plans[n].label, point: line[at], colour: planStyle(n).colour };
    });
  }

  listSwitches() {
    const without = [["needle", this.motions.every((motion) => !motion.hasNeedle)], ["aim", this.data.plans.every((plan) => !plan.aim_lps)]];
    for (const [name, hidden] of without) for (const each of document.querySelectorAll(`[data-${name}]`)) each.hidden = hidden;
    byId("devices").addEventListener("change", ({ target }) => {
      this.shown[target.dataset.key] = target.checked;
      this.redraw();
    });
    this.listStructures();
    this.data.plans.forEach((plan, n) => {
      const name = `${plan.name}${plan.accepted ? "" : " (refused)"}`;
      addSwitch(byId("plans"), { key: `plan-${n}`, name, colour: swatchOf(planStyle(n)), shown: n < this.data.passes }, (on) => {
        this.shownPlans[n] = on;
        this.redraw();
      });
      byId("followed").append(new Option(name, n));
    });
    byId("followed-row").hidden = this.data.plans.length < 2;
    byId("followed").addEventListener("change", (event) => {
      this.followed = Number(event.target.value);
      this.redraw();
    });
  }

  connectControls() {
    document.querySelector(".player").addEventListener("click", ({ target: { dataset: { stage } } }) => {
      if (stage === undefined) return;
      this.player.stop();
      this.moveTo(this.motion.starts[stage]);
    });
    if (this.breath) this.connectBreath();
    byId("follow").addEventListener("change", () => {
      this.follow(byId("follow").checked);
      this.redraw();
    });
    for (const id of ["along", "along-turn"]) byId(id).addEventListener("input", () => this.redrawSlices());
    byId("fork-before").addEventListener("click", () => this.goToBifurcation(-1));
    byId("fork-next").addEventListener("click", () => this.goToBifurcation(1));
  }

  // Let the slices go with the foremost tip, or with their cross.
  follow(on) {
    byId("follow").checked = on;
    this.moveCursors(this.motion.alongMm(this.state));
  }

  // Go to where the scope stands before the next bifurcation, or the one before.
  goToBifurcation(way) {
    this.player.stop();
    const now = 1000 * this.player.position, ticks = pausesOf(this.motion);
    const found = way > 0 ? ticks.find((tick) => tick > now) : ticks.filter((tick) => tick < now).pop();
    if (found !== undefined) this.moveTo(found / 1000);
  }

  connectBreath() {
    const breathing = new Animated(byId("breathe"), ["Breathe", "Hold"], () => this.beginBreath());
    byId("phase").addEventListener("input", () => {
      breathing.stop();
      this.breathe(Number(byId("phase").value) / 1000);
      this.redraw();
    });
  }

  // Show a phase of the breath.
  breathe(phase, exhaling = false) {
    this.phase = phase;
    this.exhaling = exhaling;
    byId("phase").value = Math.round(1000 * phase);
  }

  beginBreath() {
    let angle = this.exhaling ? 2 * Math.PI - Math.acos(1 - 2 * this.phase) : Math.acos(1 - 2 * this.phase);
    return (seconds) => {
      angle += (2 * Math.PI * seconds) / BREATH_S;
      this.breathe((1 - Math.cos(angle)) / 2, Math.sin(angle) < 0);
      this.show("moving");
      return true;
    };
  }

  moveTo(position) {
    this.player.position = position;
    this.redraw();
  }

  draw() {
    if (this.breath) this.drawBreath();
    const state = this.stateOf(this.followed, this.player.position);
    if (this.orbit && this.state && this.state.position !== state.position) this.goWith(state);
    this.state = state;
    this.player.say(this.motion.words(state));
    for (const button of document.querySelectorAll("button[data-stage]")) {
      button.setAttribute("aria-pressed", String(Number(button.dataset.stage) === state.stage));
    }
    if (this.scene) {
      this.putDevices(state);
      if (!this.leavesOut(byId("inside"))) this.bronchoscopy.draw(state, this.motion);
      this.drawScene();
    }
    this.showCharts();
    this.moveCursors(this.motion.alongMm(state));
    if (this.views && !this.leavesOut(this.slices.axial.canvas)) this.drawSlices();
  }

  // Let the 3-D view go with the scope while that moves, and back to what is fitted when it stands.
  goWith(state) {
    if (state.stage === 0) this.orbit.centre = [...state.tip];
    else if (this.state.stage === 0) this.orbit.centre = [...this.orbit.home.centre];
  }

  // Return what is where at a place of the slider, in the phase of the breath.
  stateOf(number, position) {
    const motion = this.motions[number];
    if (this.share === 0) return motion.at(position);
    const { n } = this.breath.sample(number, this.phase);
    return this.breath.carried(motion.at(position, this.breath.plans[number].margins[n]), number, this.phase);
  }

  get share() {
    return this.breath ? this.breath.share(this.phase) : 0;
  }

  get target() {
    const { target_lps: target } = this.motion.plan;
    return this.share === 0 ? target : this.breath.moved(target, this.share);
  }

  // Where the devices of a plan for a window are to end: rigid with them.
  get aim() {
    const { aim_lps: aim } = this.motion.plan;
    return aim && this.share !== 0 ? this.breath.rigid(this.followed, this.phase).place(aim) : aim;
  }

  // Bring words, clock, charts, surfaces and slices to the phase.
  drawBreath() {
    const { breath, followed, phase, share } = this;
    const words = breath.words(followed, phase, this.data.plans[followed].accepted);
    byId("phase-words").textContent = words;
    byId("phase").setAttribute("aria-valuetext", words);
    const half = this.exhaling ? -phase : phase;
    byId("clock-hand").setAttribute("transform", `rotate(${180 * (half - breath.masksPhase)} 100 92)`);
    if (this.scene) this.scene.share = share;
    if (this.image) this.image.share = share;
    document.body.style.setProperty("--phase", 100 * phase);
  }

  drawView() {
    if (!this.state) return;
    this.putDevices(this.state);
    this.drawScene();
  }

  putDevices(state) {
    const { scene, shown, motion, target, aim, orbit: { distance } } = this;
    showDevices(scene, motion.plan, this.shownPlans[this.followed] ? state : null, distance, shown);
    this.motions.forEach(({ plan }, n) => {
      const isShown = n !== this.followed && this.shownPlans[n];
      showOther(scene, `plan ${n}`, n, plan, isShown ? this.stateOf(n, 1) : null, distance, shown);
    });
    showBall(scene, "aim", shown.aim && aim, AIM_MM);
    showBall(scene, "target", shown.target && target);
    scene.fit();
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    const { target, state, views } = this, following = byId("follow").checked;
    if (following) [views.place, views.centre] = [[...state.tip], [...state.tip]];
    const lines = deviceLines(this.motion.plan, state, this.shown);
    const marks = { lines, target: this.shown.target ? target : null };
    views.draw({ ...STANDARD, across: this.across(state, following), along: this.along(state, following) }, marks, isCoarse);
    this.panel.show();
    this.drawTipSection(state);
    byId("slice-place").textContent = `Through ${following ? "the foremost tip, at" : "the cross, at"} LPS ${views.place.map((v) => v.toFixed(1)).join(", ")} mm.`;
    if (!following) this.moveCursors(alongLine(this.devices, views.place).alongMm);
  }

  // The plane across the foremost tip, or across the devices where they are nearest to the cross.
  across(state, following) {
    const widthMm = Math.min(this.views.widthMm, MOST_ACROSS_MM), line = [...state.scope, ...lineOf(state)];
    if (following) return { ...planeAcross(state.direction), through: state.tip, widthMm };
    const { place, direction } = alongLine(line, this.views.place);
    return { ...planeAcross(direction), through: place, widthMm };
  }

  // The plane along the needle, or along the scope, turned about it.
  along(state, following) {
    const end = this.stateOf(this.followed, 1), ofNeedle = byId("along").value === "needle" && end.needle.length > 1;
    const { eye, forward, up } = state.camera;
    const { direction, beside } = ofNeedle ? bendOf(end.needle, up) : { direction: forward, beside: up };
    const degrees = Number(byId("along-turn").value), plane = planeAlong(direction, beside, degrees);
    const first = ofNeedle ? end.needle[0] : eye, normal = cross(plane.right, plane.up);
    // A plane that is turned about the axis holds the axis: where it is looked at moves along it only.
    const at = following ? state.tip : this.views.place, through = mix(first, [0, 1, 2].map((k) => first[k] + direction[k]), dot(minus(at, first), direction));
    const away = ofNeedle ? Math.max(...end.needle.map((place) => Math.abs(dot(minus(place, first), normal)))) : 0;
    byId("along-words").textContent = `${degrees}°${ofNeedle ? `; the needle leaves the plane by ${away.toFixed(1)} mm at most` : ""}`;
    this.alongPlane = { ...plane, through };
    return this.alongPlane;
  }

  drawTipSection(state) {
    const canvas = byId("gap"), caption = byId("gap-words");
    canvas.hidden = this.share !== 0;
    if (this.share === 0) this.sections[this.followed].draw(canvas, caption, state.moved, this.motion.plan.radius_mm.scope);
    else caption.textContent = "The cross-section at the scope's tip is known in the phase of the masks alone.";
  }

  // Show the charts of the plan that is followed, of the distances those at the computed phase that is nearest.
  showCharts() {
    const sample = this.share === 0 ? "masks" : String(this.breath.sample(this.followed, this.phase).n);
    for (const each of document.querySelectorAll("[data-of-plan]")) each.hidden = Number(each.dataset.ofPlan) !== this.followed;
    for (const each of document.querySelectorAll("[data-sample]")) each.hidden = each.dataset.sample !== sample;
  }

  moveCursors(mm) {
    document.body.style.setProperty("--along-mm", mm);
  }

  // What a test may read; docs/how_to/report.md names the fields.
  report() {
    const { state } = this;
    return {
      ...super.report(),
      plan: this.followed, plans: this.shownPlans, position: state.position, stage: STAGES[state.stage],
      scope_mm: state.scopeMm, outer_mm: state.outerMm, inner_mm: state.innerMm, needle_mm: state.needleMm,
      following: byId("follow").checked, along: this.alongPlane, pauses: pausesOf(this.motion),
      section: this.sections[this.followed].at(state.moved), prompts: bifurcationsAhead(this.motion, state).map(({ number }) => number),
      named: this.bronchoscopy ? this.bronchoscopy.named.map(({ branch }) => branch) : [],
      phase: this.phase, target_lps: this.target, tip_lps: state.tip, needle_lps: state.needle, camera: state.camera, devices: { ...this.shown },
      solids: this.scene ? Object.fromEntries([...this.scene.solids].map(([key, s]) => [key, s.count / 3])) : {},
      view: this.orbit ? { yaw: this.orbit.yaw, pitch: this.orbit.pitch, distance: this.orbit.distance, edges: this.orbit.edges() } : null,
    };
  }
}

// Return a plan's style as the background of a swatch.
function swatchOf({ colour, bands }) {
  if (!bands) return colour;
  const px = (mm) => `${1.5 * mm}px`, [on, off] = bands;
  return `repeating-linear-gradient(90deg, ${colour} 0 ${px(on)}, #ffffff ${px(on)} ${px(on + off)})`;
}

openPage(new PlanPage(reportData()));
