// The page of the explorer: what is asked, what is shown, and how both follow from the address.
import { AnatomyPage, byId, openPage } from "../report/anatomy_page.js";
import { planStyle } from "../report/colours.js";
import { Motion } from "../report/motion.js";
import { STANDARD } from "../report/slices.js";
import { ballAround, sideOf } from "../report/orbit.js";
import { oncePerFrame } from "../report/structures.js";
import { alongLine } from "../report/surfaces.js";
import { minus, mix, norm, rgb, unit } from "../report/vectors.js";
import { VoxelImage } from "../report/voxel_image.js";
import { placedVolume } from "../report/voxels.js";
import { Compared } from "./compare.js";
import { Connection } from "./connection.js";
import { CtSource } from "./ct_source.js";
import { COMPARED, comparedLines, deviceLines, showCompared, showDevices, showTarget } from "./devices.js";
import { Exits } from "./exits.js";
import { connectHelp, connectKeys } from "./keys.js";
import { PlanPanel } from "./plan_panel.js";
import { connectPointer } from "./pointer.js";
import { ReachLayer } from "./reach_layer.js";
import { MOST_COMPARED, planKey, planQuestion, State, systemKey, whatIf } from "./state.js";
import { Tips } from "./tips.js";
import { WhatIfPanel } from "./what_if.js";
import { errorWords, fillRows, lpsText, made, mm, placeWords } from "./widgets.js";

const PLAY_S = 12, MOST_STEP_S = 0.25;
const KEPT_PLANS = 30, REST_MS = 250;
// Answers that come soon, and are shown before a better picture is drawn.
const SOON = ["exits", "plan", "place", "appraise"];
const NEAR_NODULE_MM = 25, SCOPE_POINTS = 16, AROUND_PLAN_MM = 12;

class ExplorerPage extends AnatomyPage {
  constructor() {
    super({ structures: [], breath: null });
    this.plans = new Map();
    this.asking = {};
    this.awaited = 0;
    this.times = {};
    this.exits = this.tips = this.reach = this.motion = null;
    this.targetLps = null;
    this.stale = { scene: true, slices: true };
    const later = oncePerFrame((atOnce) => (this.stale.scene ? this.show(atOnce ? "rest" : "moving") : this.draw()));
    const mark = (changes) => Object.assign(this.stale, changes);
    this.redraw = () => later(mark({ scene: true, slices: true }));
    this.redraw.now = () => later.now(mark({ scene: true, slices: true }));
    this.redrawScene = () => later(mark({ scene: true }));
    // At once, and as coarsely as a slow machine draws what moves.
    this.redrawFast = () => this.show("moving", mark({ slices: true }));
  }

  async open() {
    this.connection = await Connection.open(() => this.say("The explorer has ended: start `lungaccess view` again."));
    this.say("Reading the patient…");
    await this.asked("patient", {}, (facts) => this.takePatient(facts));
    this.say("Loading the anatomy…");
    await this.asked("scene", {}, (part) => this.takeScene(part));
    await this.scenePart;
    this.listStructures();
    this.connectControls();
    this.say("Ready. Click into a slice, or pick a nodule.");
    this.ready = true;
    this.follow();
  }

  // On a slow machine a picture takes seconds and would keep answers waiting: it gets better when all have come, and the
  // finest are only saved.
  show(quality) {
    this.stale.scene = true;
    super.show(quality);
    if (!this.scene || !this.scene.slow || this.tools.recording) return;
    clearTimeout(this.better);
    const later = () => (this.awaited ? (this.better = setTimeout(later, REST_MS)) : this.show("rest"));
    if (quality === "moving") this.better = setTimeout(later, REST_MS);
  }

  say(words) {
    byId("status").textContent = words;
  }

  // Ask, and show an error where that is the answer; `done` is the last message.
  async asked(ask, values, part) {
    const last = await this.connection.ask(ask, values, part).done;
    if (last.answer === "error") this.say(errorWords(last.error));
    return last;
  }

  // Ask so that a later question with the same name takes the place of this one.
  async latest(name, values, part) {
    this.forget(name);
    const number = this.asking[name], isLatest = () => this.asking[name] === number;
    const counts = SOON.includes(name) ? 1 : 0;
    this.awaited += counts;
    const last = await this.connection.ask(name, values, (message) => {
      if (!isLatest()) return null;
      return message.answer === "progress" ? this.showProgress(message) : part(message);
    }).done;
    this.awaited -= counts;
    if (!isLatest()) return { answer: "superseded" };
    this.showProgress(null);
    return last;
  }

  // Take no more of what is answered to the latest question of a name.
  forget(name) {
    this.asking[name] = (this.asking[name] || 0) + 1;
  }

  showProgress(message) {
    const bar = byId("progress");
    bar.hidden = message === null;
    if (!message) return;
    if (message.share === null) bar.removeAttribute("value");
    else bar.value = message.share;
    const share = message.share === null ? "" : `: ${Math.round(100 * message.share)} %`;
    this.say(`${message.what[0].toUpperCase()}${message.what.slice(1)}${share}`);
  }

  takePatient(facts) {
    this.facts = facts;
    byId("patient").textContent = facts.patient;
    document.title = `${facts.patient} - lungaccess`;
    this.data = { ...this.data, patient: facts.patient, page: "explorer" };
    byId("warnings").replaceChildren(...facts.warnings.map((words) => made("li", {}, words)));
    byId("nodule").replaceChildren(new Option(facts.targets.length ? "choose" : "none", ""), ...facts.targets.map(({ text, lobe }) =>
      new Option(lobe ? `${text}, ${lobe}` : text, text)));
    this.start = [...(facts.targets[0] ? facts.targets[0].lps_mm : facts.carina_lps)];
    this.state = new State(facts.first_system, () => this.follow());
    this.whatIfPanel = new WhatIfPanel(facts, this.state);
    this.planPanel = new PlanPanel(this);
    this.compared = new Compared(this);
  }

  takeScene({ image, structures }) {
    if (image) this.imagePart = VoxelImage.of(image).then((made) => this.takeImage(made));
    if (structures) this.scenePart = this.imagePart.then(() => this.takeStructures(structures));
  }

  takeImage(image) {
    this.image = image;
    if (this.facts.has_ct) image.finer = new CtSource(this.connection);
    byId("ct-controls").hidden = !image.hasCt;
    this.openSlices();
    byId("reach-slices").checked = !image.hasCt;
  }

  async takeStructures(structures) {
    this.structures = structures;
    const isOpen = await this.openScene((size) => (1.05 * Math.max(...size)) / Math.tan((15 * Math.PI) / 180) / 2 + size[1] / 2);
    this.linkSlices({ placed: () => this.describe(), picked: (place) => this.chooseTarget(lpsText(place)) });
    this.views.lookAt(this.start);
    if (isOpen) {
      this.orbit.changed = this.redrawScene;
      connectPointer(this);
    }
    this.redraw();
  }

  connectControls() {
    byId("undo").addEventListener("click", () => history.back());
    byId("redo").addEventListener("click", () => history.forward());
    byId("target-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.chooseTarget(byId("target-text").value.trim());
    });
    byId("nodule").addEventListener("change", (event) => event.target.value && this.chooseTarget(event.target.value));
    byId("cross-target").addEventListener("click", () => this.chooseTarget(lpsText(this.place)));
    byId("reach-slices").addEventListener("change", () => this.redrawSlices());
    byId("reach-scene").addEventListener("change", () => this.showReach());
    byId("exits-by").addEventListener("change", () => this.showExits());
    byId("tip-back").addEventListener("click", () => this.moveTip(-1));
    byId("tip-forward").addEventListener("click", () => this.moveTip(1));
    byId("free").addEventListener("click", () => this.state.set({ exit: null, tip: null }));
    byId("position").addEventListener("input", () => {
      this.stop();
      this.redraw();
    });
    byId("play").addEventListener("click", () => (this.playing ? this.stop() : this.play()));
    connectHelp();
    connectKeys(this);
    this.planPanel.connect();
    this.whatIfPanel.connect();
  }

  // Where the cross is.
  get place() {
    return this.views ? this.views.place : this.start;
  }

  // Look at a place in all slices, and say what is there.
  moveTo(place) {
    this.views.lookAt(place);
    this.showCross();
    this.describe();
  }

  describe() {
    this.latest("place", { point: this.place }, (found) => {
      byId("place-table").hidden = false;
      const lobe = found.lobe ? `, ${found.lobe}` : "";
      byId("place-words").textContent = `${found.tissue}${lobe} at LPS ${placeWords(found.lps_mm)} mm`;
      fillRows(byId("place"), Object.entries(found.distance_mm).map(([name, value]) =>
        [`to ${name}`, value >= 30 ? "30 mm or more" : mm(value, 2)]));
      const isTarget = this.targetLps && norm(minus(this.place, this.targetLps)) < 0.1;
      byId("cross-target").hidden = !found.may_be_target || Boolean(isTarget);
      this.placeFound = found;
    });
  }

  chooseTarget(text) {
    this.times.click = performance.now();
    this.state.set({ target: text, exit: null, tip: null });
  }

  chooseExit(entry) {
    this.state.set({ exit: entry, tip: null });
  }

  // Choose the next place of the scope along the airway.
  moveTip(way) {
    const from = this.tips && (this.tips.chosen(this.state.asked.tip) ?? this.tips.nearest(this.motion ? this.motion.plan.scope_tip_lps : this.place));
    const next = this.tips && this.tips.next(from, way, this.targetLps);
    if (next !== null && next !== undefined) this.state.set({ tip: next, exit: null });
  }

  // Show what the address says: everything begins here.
  follow() {
    if (!this.ready) return;
    const { asked } = this.state;
    this.whatIfPanel.show();
    byId("nodule").value = this.facts.targets.some(({ text }) => text === asked.target) ? asked.target : "";
    byId("target-text").value = asked.target;
    byId("target-error").hidden = true;
    if (asked.target) this.seek(this.prepare());
    else {
      this.prepare();
      this.clear();
    }
    this.compared.follow();
  }

  clear() {
    this.seeking = null;
    this.exits = this.motion = this.targetLps = this.plan = null;
    this.planPanel.clear("Choose a target: click into a slice, or pick a nodule.");
    this.showExits();
    this.showPlan();
    this.fitImage(this.place);
  }

  // Prepare the system, then show what it reaches; resolves when its atlas is known, with whether it is.
  prepare() {
    const key = systemKey(this.state.asked);
    if (this.systemKey !== key) {
      this.systemKey = key;
      this.preparing = this.prepareAnew();
    }
    return this.preparing;
  }

  async prepareAnew() {
    // What was painted holds for the system before.
    if (this.reach) this.reach = this.reach.outdated();
    this.showReach();
    const began = performance.now();
    const last = await this.latest("prepare", { what_if: whatIf(this.state.asked) }, (found) => {
      this.tips = new Tips(found);
      this.prepared = found;
      this.whatIfPanel.prepared(found);
      this.showExits();
    });
    this.whatIfPanel.fail(last.answer === "error" ? errorWords(last.error) : "");
    if (last.answer === "error") this.systemKey = null;
    if (last.answer !== "end") return last;
    this.latest("ready", { what_if: whatIf(this.state.asked) }, () => null);
    this.seekReach(began);
    return last;
  }

  async seekReach(began) {
    let layer = null;
    const last = await this.latest("reach", { what_if: whatIf(this.state.asked), around: this.targetLps || this.place }, (part) => {
      if (part.answer === "reach grid") {
        layer = new ReachLayer(part, Object.fromEntries(Object.entries(this.facts.reach_colours).map(([name, colour]) => [name, rgb(colour)])), this.reach);
        return;
      }
      layer.take(part);
      if (this.reach !== layer) this.times.reach = performance.now() - began;
      this.reach = layer;
      this.showReach();
    });
    if (last.answer !== "error") return;
    this.reach = null;
    this.showReach(errorWords(last.error));
  }

  // Whether the system has a needle: without one the tubes themselves reach the target.
  get hasNeedle() {
    const { system } = this.whatIfPanel;
    return !system || system.needle_length_mm !== null;
  }

  showReach(words = null) {
    if (!this.views) return;
    byId("reach-words").textContent = words ?? (this.reach ? this.reach.words(this.hasNeedle ? "a single arc" : "the tubes") : "");
    const shown = byId("reach-scene").checked && this.reach;
    if (this.scene && (shown || this.scene.points.has("reach"))) {
      this.scene.setPoints("reach", shown ? this.reach.points() : null);
      this.redrawScene();
    }
    this.redrawSlices();
  }

  // Ask for exits and plan once the system is prepared; what is known already is shown at once.
  async seek(preparing) {
    const { asked } = this.state, question = planQuestion(asked), key = planKey(asked), known = this.plans.get(key);
    const click = this.times.click || performance.now();
    this.times.click = null;
    this.times.exits = this.times.plan = null;
    this.exits = null;
    // What still comes of the questions before is not taken.
    for (const name of ["exits", "plan"]) this.forget(name);
    if (known) this.takePlan(known, key);
    else {
      this.planPanel.searching();
      this.say("Planning…");
    }
    const isNow = this.seeking = {}, { answer, error } = await preparing;
    if (isNow !== this.seeking || answer === "superseded") return;
    if (error) {
      this.planFailed(error);
      return;
    }
    this.seekExits(question, asked, click);
    if (!known || !known.final) this.seekPlan(question, key, click);
  }

  seekExits({ target, what_if }, { tip, exit }, click) {
    if (!this.hasNeedle) {
      this.showExits("This system has no needle: its tubes go to the target themselves, and no exit is to be chosen. The reach shows what they can do.");
      return;
    }
    const more = tip !== null && exit === null ? { scope_tip: tip } : {};
    this.latest("exits", { target, what_if, ...more }, (found) => {
      this.exits = new Exits(found);
      this.takeTarget(found.target_lps);
      this.showExits();
      if (this.times.exits === null) {
        this.redrawFast();
        this.times.exits = performance.now() - click;
      }
    }).then((last) => this.exitsEnded(last));
  }

  seekPlan(question, key, click) {
    this.latest("plan", question, async (found) => {
      if (found.answer === "no_plan") this.takeNoPlan(found);
      else {
        await this.takePlan(found, key);
        if (this.times.plan === null) {
          this.redrawFast();
          this.times.plan = performance.now() - click;
        }
      }
    }).then((last) => last.answer === "error" && this.planFailed(last.error));
  }

  exitsEnded(last) {
    if (last.answer !== "error") return;
    byId("exits-words").textContent = errorWords(last.error);
    this.exits = null;
    this.showExits(errorWords(last.error));
  }

  planFailed(error) {
    this.motion = this.plan = null;
    byId("target-error").hidden = error.kind !== "TargetError" && error.kind !== "FrameError";
    byId("target-error").textContent = errorWords(error);
    this.planPanel.clear(errorWords(error));
    this.say("No plan.");
    this.showPlan();
  }

  takeTarget(lps) {
    if (this.targetLps && norm(minus(this.targetLps, lps)) < 1e-6) return;
    this.targetLps = [...lps];
    this.moveTo(lps);
    if (this.scene) showTarget(this.scene, lps);
    this.fitImage(lps);
  }

  // Fetch fine voxels around a point.
  fitImage(around) {
    this.latest("image", { around }, async ({ image }) => {
      const [labels, ct] = await Promise.all([
        placedVolume(image.labels[0]), image.ct ? placedVolume(image.ct[0], image.hounsfield) : null,
      ]);
      this.image.labels[1] = labels;
      if (ct) this.image.ct[1] = ct;
      this.redrawSlices();
    });
  }

  async takePlan(found, key) {
    const known = this.plans.get(key);
    const plan = { ...(known || {}), ...found };
    if (found.packed) plan.motion = await Motion.of({ ...found.packed, scope_tip_lps: found.scope_tip_lps });
    this.plans.delete(key);
    this.plans.set(key, plan);
    if (this.plans.size > KEPT_PLANS) this.plans.delete(this.plans.keys().next().value);
    if (key !== planKey(this.state.asked)) return;
    const first = this.motion === null;
    this.takeTarget(plan.motion.plan.target_lps);
    this.plan = plan;
    this.motion = plan.motion;
    this.planPanel.show(plan);
    this.showPlan();
    if (first && this.orbit) this.lookAtPlan();
    if (!plan.final) return;
    this.say(`Plan with cost ${plan.cost.toPrecision(4)} after ${this.state.asked.iterations} iterations.`);
    if (!plan.appraisal) await this.appraise(plan);
    else this.planPanel.appraised(plan);
  }

  appraise(plan) {
    return this.latest("appraise", { plan: plan.digest }, (found) => {
      plan.appraisal = found;
      if (this.plan === plan) this.planPanel.appraised(plan);
      this.compared.list();
    });
  }

  takeNoPlan(found) {
    this.motion = this.plan = null;
    this.takeTarget(found.target_lps);
    this.planPanel.noPlan(found);
    this.say("No plan was found.");
    this.showPlan();
  }

  showPlan() {
    byId("player").hidden = !this.motion;
    this.drawn = null;
    if (this.scene && !this.targetLps) showTarget(this.scene, null);
    if (this.scene) this.scene.setFocus(this.motion ? this.devices : null);
    if (this.motion && this.orbit) this.fitToPlan();
    this.redraw();
  }

  showExits(words = null) {
    const { exits } = this, { asked } = this.state;
    const chosen = exits ? exits.numberOf(asked.exit) : -1;
    byId("exits-words").textContent = words ?? (exits ? exits.words() : "");
    byId("exits-box").hidden = !exits || !exits.count;
    if (exits && exits.count) {
      const more = exits.list(byId("exits"), chosen, (entry) => this.chooseExit(entry));
      byId("exits-more").textContent = more > 0 ? `${more} more are painted` : "";
    }
    if (this.scene) {
      this.scene.setPoints("exits", exits && exits.count ? exits.points(byId("exits-by").value, chosen) : null);
      const tip = this.tips && this.tips.place(asked.tip);
      this.scene.setPoints("tip", tip ? { places: tip, colours: rgb("#56B4E9"), radii: 2.2 } : null);
    }
    const of = asked.exit !== null ? "The plan starts from the chosen exit." : asked.tip !== null ? "The plan starts from the chosen place of the scope tip." : "Exit and scope tip are chosen by the planner.";
    byId("chosen-words").textContent = of;
    byId("free").disabled = asked.exit === null && asked.tip === null;
    this.redraw();
  }

  // The line of tubes and needle of the plan at their end.
  get devices() {
    const end = this.motion.at(1);
    return [...end.outer, ...end.middle, ...end.inner, ...end.needle];
  }

  // Name the plan as what can be fitted into the 3-D view: its devices beyond the scope, and the end of the scope.
  fitToPlan() {
    const points = [...this.motion.at(1).scope.slice(-SCOPE_POINTS), ...this.devices, this.motion.plan.target_lps];
    const { centre, radius } = ballAround(points);
    this.orbit.setHome("plan", centre, radius + AROUND_PLAN_MM);
  }

  // Look at the plan from the side from which it is seen long, or else at the target.
  lookAtPlan() {
    if (!this.orbit) return;
    if (!this.motion) {
      this.orbit.setHome("plan", this.targetLps || this.place, NEAR_NODULE_MM);
      this.orbit.fit("plan");
      return;
    }
    this.orbit.home = this.orbit.homes.plan;
    this.orbit.look(sideOf(this.devices));
  }

  cutThrough() {
    if (!this.motion) return this.targetLps ? { point: this.targetLps, name: "the target" } : null;
    const { needle, inner } = this.motion.at(1), [line, name] = needle.length > 1 ? [needle, "the needle"] : [inner, "the tube"];
    const [first, last] = [line[0], line[line.length - 1]];
    return line.length > 1 ? { point: mix(first, last, 0.5), axis: unit(minus(last, first)), name } : null;
  }

  nameOf(hit) {
    const names = { scope: "Bronchoscope", outer: "Outer tube", middle: "Middle tube", inner: "Inner tube", needle: "Needle", target: "Target",
      exits: `Exit ${hit.index + 1}`, tip: "Chosen place of the scope tip", preview: "Let go to choose", reach: "Voxel of the reach", measure: "Measured line" };
    if (hit.key.startsWith(COMPARED)) return `Compared plan ${hit.key.slice(COMPARED.length)}`;
    return names[hit.key] || super.nameOf(hit);
  }

  distancesOf(point) {
    const needle = this.motion ? this.motion.at(1).needle : [];
    const axis = needle.length > 1 ? [`${mm(alongLine(needle, point).awayMm)} to the needle's axis`] : [];
    return [...axis, ...(this.targetLps ? [`${mm(norm(minus(point, this.targetLps)))} to the target`] : [])];
  }

  alongMm(a, b) {
    return this.motion ? Math.abs(alongLine(this.devices, a).alongMm - alongLine(this.devices, b).alongMm) : null;
  }

  // The numbers of compared plans, each at its needle.
  labels() {
    return this.compared.shown.map(({ motion, number }) => {
      const { needle } = motion.at(1);
      return { text: String(number), point: needle[Math.floor(needle.length / 2)] || motion.plan.target_lps, colour: planStyle(number).colour };
    });
  }

  films() {
    return [{ key: "deployment", name: "the deployment" }];
  }

  filmAt(_kind, share) {
    byId("position").value = Math.round(1000 * share);
  }

  get position() {
    return Number(byId("position").value) / 1000;
  }

  play() {
    let position = this.position >= 1 ? 0 : this.position, last = performance.now();
    const step = (now) => {
      if (!this.playing) return;
      position = Math.min(position + Math.min(Math.max(now - last, 0) / 1000, MOST_STEP_S) / PLAY_S, 1);
      last = now;
      byId("position").value = Math.round(1000 * position);
      this.show("moving");
      if (position >= 1) this.stop();
      else this.playing = requestAnimationFrame(step);
    };
    this.playing = requestAnimationFrame(step);
    byId("play").textContent = "Pause";
  }

  stop() {
    if (this.playing) cancelAnimationFrame(this.playing);
    this.playing = null;
    byId("play").textContent = "Play";
  }

  draw() {
    const state = this.motion ? this.motion.at(this.position) : null;
    if (state) {
      const words = this.motion.words(state);
      byId("position-words").textContent = words;
      byId("position").setAttribute("aria-valuetext", words);
    }
    const { scene, slices } = this.stale;
    this.stale = { scene: false, slices: false };
    if (scene && this.scene && this.orbit && this.views) {
      this.drawDevices(state);
      this.scene.fit();
      this.drawScene();
    }
    if (slices && this.views) this.drawSlices();
    byId("reach-key").hidden = !byId("reach-slices").checked && !byId("reach-scene").checked;
    if (!byId("reach-key").childElementCount && this.facts) this.listReachKey();
  }

  listReachKey() {
    const names = { "direct arc": "reached by a single arc", unreachable: "no needle can end there" };
    byId("reach-key").append(...Object.entries(names).map(([kind, words]) => {
      const swatch = made("span", { className: "swatch" });
      swatch.style.background = this.facts.reach_colours[kind];
      return made("li", {}, swatch, words);
    }));
  }

  // The solid bodies are made again only where they changed.
  drawDevices(state) {
    const key = JSON.stringify([state && this.plan.digest, this.position, Math.round(8 * Math.log(this.orbit.distance)), this.compared.key]);
    if (this.drawn === key) return;
    this.drawn = key;
    showDevices(this.scene, this.motion, state, this.orbit.distance);
    showCompared(this.scene, this.compared.shown, MOST_COMPARED, this.orbit.distance);
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    this.image.overlay = byId("reach-slices").checked && this.reach ? this.reach.painter() : null;
    const of = this.motion ? deviceLines(this.motion, this.motion.at(this.position)) : [];
    this.views.draw(STANDARD, { lines: [...comparedLines(this.compared.shown), ...of], target: this.targetLps }, isCoarse);
  }

  // What a test may read.
  report() {
    const state = this.motion ? this.motion.at(this.position) : null;
    return {
      ...super.report(), asked: { ...this.state.asked }, place_lps: this.place, target_lps: this.targetLps,
      exits: this.exits ? { count: this.exits.count, complete: this.exits.answer.complete, entries: [...this.exits.entries], tips: [...this.exits.tips] } : null,
      plan: this.plan ? { digest: this.plan.digest, final: this.plan.final, cost: this.plan.cost, command: this.plan.command, curve: this.plan.curve,
        appraised: Boolean(this.plan.appraisal), scope_tip_lps: this.plan.scope_tip_lps, exit_lps: this.plan.exit_lps, system: this.plan.system } : null,
      tip_lps: state ? state.tip : null, compared: this.compared.report(), times_ms: { ...this.times },
      reach: this.reach ? { share: this.reach.share, system: this.reach.grid.system } : null,
      finer: this.slices ? Object.fromEntries(Object.entries(this.slices).map(([name, slice]) => [name, slice.isFine])) : {},
      place: this.placeFound || null, points: this.scene ? Object.fromEntries([...this.scene.points].map(([key, p]) => [key, p.count])) : {},
    };
  }
}

const page = new ExplorerPage();
window.lungaccessExplorer = page;
openPage(page);
