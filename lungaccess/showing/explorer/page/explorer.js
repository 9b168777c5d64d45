// The page of the explorer: what is asked, what is shown, and how both follow from the address.
import { openPage } from "../report/anatomy_page.js";
import { Bronchoscopy } from "../report/bronchoscopy.js";
import { planStyle } from "../report/colours.js";
import { DevicePage } from "../report/device_page.js";
import { deviceLines, otherLines, showBall, showDevices, showOther } from "../report/devices.js";
import { Motion } from "../report/motion.js";
import { STANDARD } from "../report/slices.js";
import { Player } from "../report/player.js";
import { byId, oncePerFrame } from "../report/structures.js";
import { minus, norm, rgb } from "../report/vectors.js";
import { VoxelImage } from "../report/voxel_image.js";
import { placedVolume } from "../report/voxels.js";
import { Asker } from "./asker.js";
import { Compared } from "./compare.js";
import { connectKeys } from "./keys.js";
import { connectPainting } from "./paint.js";
import { Panes } from "./panes.js";
import { PlanPanel } from "./plan_panel.js";
import { connectPointer } from "./pointer.js";
import { Search } from "./search.js";
import { FREE, MOST_COMPARED, planKey, State } from "./state.js";
import { WhatIfPanel } from "./what_if.js";
import { fillList, fillRows, lpsText, mm, say } from "./widgets.js";

const KEPT_PLANS = 30, REST_MS = 250, DARK_AIRWAY = "#A6D8F8", COMPARED = "compared ";

class ExplorerPage extends DevicePage {
  constructor() {
    super({ structures: [], breath: null });
    this.player = new Player({ redraw: () => this.redraw(), show: () => this.redrawFast() });
    this.plans = new Map();
    this.search = new Search(this);
    this.exits = this.tips = this.reach = this.motion = null;
    this.target = this.failure = null;
    this.sharp = 0;
    this.stale = { scene: true, slices: true };
    const later = oncePerFrame((atOnce) => (this.stale.scene ? this.show(atOnce ? "rest" : "moving") : this.draw()));
    const mark = (changes) => Object.assign(this.stale, changes);
    this.redraw = () => later(mark({ scene: true, slices: true }));
    this.redraw.now = () => later.now(mark({ scene: true, slices: true }));
    this.redrawScene = () => later(mark({ scene: true }));
    // At once, and as coarsely as a slow machine draws what moves.
    this.redrawFast = () => this.show("moving", mark({ slices: true }));
    this.setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
    byId("theme").addEventListener("click", () => this.setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
  }

  // Put the page on a light or a dark ground, on which the airway is lighter, so that it differs from vessels.
  setTheme(theme) {
    document.documentElement.dataset.theme = theme;
    const airway = this.structures.find(({ key }) => key === "airway");
    if (this.scene && airway) this.scene.surfaces.get("airway").colour = rgb(theme === "dark" ? DARK_AIRWAY : airway.colour);
    this.redraw();
  }

  async open() {
    this.asker = new Asker();
    await this.asker.connect();
    say("Reading the patient…");
    const patient = await this.asker.ask("patient", {}, (facts) => this.takePatient(facts));
    if (patient.answer === "error") return;
    say("Loading the anatomy…");
    const scene = await this.asker.ask("scene", {}, (part) => this.takeScene(part));
    if (scene.answer === "error") return;
    this.listStructures();
    this.connectControls();
    say("Ready. Click into a slice, or pick a nodule.");
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
    const later = () => (this.asker.awaited ? (this.better = setTimeout(later, REST_MS)) : this.show("rest"));
    if (quality === "moving") this.better = setTimeout(later, REST_MS);
  }

  takeFacts(facts) {
    this.facts = facts;
    fillList(byId("warnings"), facts.warnings);
    const options = facts.targets.map(({ text, label }) => new Option(label, text));
    byId("nodule").replaceChildren(new Option(options.length ? "choose" : "none", ""), ...options);
  }

  takePatient(facts) {
    this.takeFacts(facts);
    byId("patient").textContent = facts.patient;
    document.title = `${facts.patient} - lungaccess`;
    this.data = { ...this.data, patient: facts.patient, page: "explorer" };
    this.start = [...(facts.targets[0] ? facts.targets[0].lps_mm : facts.carina_lps)];
    this.state = new State(facts.first_system, () => this.follow());
    this.whatIfPanel = new WhatIfPanel(facts, this.state);
    this.planPanel = new PlanPanel(this);
    this.compared = new Compared(this);
  }

  async takeScene({ image, structures }) {
    if (structures) return this.takeStructures(structures);
    this.image = await VoxelImage.of(image);
    if (this.facts.has_ct) this.image.finer = { slice: (raster) => this.sharpSlice(raster) };
    byId("ct-controls").hidden = !this.image.hasCt;
    byId("reach-slices").checked = !this.image.hasCt;
    return this.openSlices();
  }

  // Return the values of the CT, as the server has it, at the pixels of a plane; voxels.js says what a source is.
  async sharpSlice(raster) {
    let values = null;
    // A slot of its own: each slice asks one at a time, and none takes the place of another.
    await this.asker.ask("slice", { ...raster, slot: `${++this.sharp}` }, ({ arrays: { hu } }) => (values = hu));
    return values;
  }

  async takeStructures(structures) {
    this.structures = structures;
    const isOpen = await this.openScene();
    this.panes = new Panes(this.redraw);
    this.linkSlices({ placed: () => this.describe(), picked: (place) => this.choose({ target: lpsText(place) }) });
    connectPainting(this);
    this.views.lookAt(this.start);
    this.setTheme(document.documentElement.dataset.theme);
    if (isOpen) {
      this.orbit.changed = this.redrawScene;
      this.bronchoscopy = new Bronchoscopy(this.scene, byId("inside"), byId("inside-place"), byId("inside-prompt"));
      connectPointer(this);
    }
  }

  connectControls() {
    const clicks = {
      undo: () => history.back(), redo: () => history.forward(), outline: () => this.outline(),
      "cross-target": () => this.choose({ target: lpsText(this.place) }), free: () => this.state.set(FREE),
      "tip-back": () => this.moveTip(-1), "tip-forward": () => this.moveTip(1), "help-open": () => byId("help").showModal(),
    };
    for (const [id, act] of Object.entries(clicks)) byId(id).addEventListener("click", act);
    byId("target-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.choose({ target: byId("target-text").value.trim() });
    });
    byId("nodule").addEventListener("change", (event) => event.target.value && this.choose({ target: event.target.value }));
    byId("reach-slices").addEventListener("change", () => this.redrawSlices());
    byId("reach-scene").addEventListener("change", () => this.showReach());
    byId("exits-by").addEventListener("change", () => this.showExits());
    connectKeys(this);
    this.whatIfPanel.connect();
  }

  get end() {
    return this.motion && this.motion.end;
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
    this.asker.ask("place", { point: this.place }, (found) => {
      const isTarget = this.target && norm(minus(this.place, this.target)) < 0.1;
      const known = isTarget && this.facts.targets.find(({ text }) => text === this.state.asked.target);
      const near = Object.entries(found.distance_mm).filter(([, value]) => value < 30).map(([name, value]) => `${mm(value)} to ${name}`);
      byId("place-words").textContent = [
        known ? known.label : [found.tissue, found.lobe].filter(Boolean).join(", "), ...near, lpsText(found.lps_mm),
      ].join("; ");
      byId("cross-target").hidden = !found.may_be_target || Boolean(isTarget);
      byId("outline").hidden = !this.facts.may_outline || found.tissue === "nodule";
      if (this.outlined && norm(minus(this.place, this.outlined)) < 0.1) return;
      this.outlined = null;
      byId("outline").textContent = "Outline a nodule at the cross";
      this.placeFound = found;
    });
  }

  // Outline the nodule at the cross at once; a second press makes it part of the patient, which is opened anew.
  async outline() {
    const point = this.outlined || [...this.place], take = Boolean(this.outlined);
    byId("target-error").textContent = "";
    await this.asker.ask("outline", { point, take }, async (found) => {
      if (take) {
        history.replaceState(null, "", `/#${new URLSearchParams({ target: found.target })}`);
        location.reload();
        return;
      }
      await this.takeFine(found.image);
      this.outlined = point;
      byId("outline").textContent = `Add this nodule of ${mm(found.diameter_mm)}, ${found.volume_ml.toFixed(2)} ml, and plan to it`;
    }, (words) => (byId("target-error").textContent = words));
  }

  // Choose a target, an exit (an entry of the atlas) or a tip of the scope: { target }, { exit } or { tip }.
  choose(what) {
    this.state.set({ ...FREE, ...what });
  }

  // Choose the next place of the scope along the airway.
  moveTip(way) {
    const { tips, motion, state: { asked } } = this;
    const from = tips?.place(asked.tip) ? asked.tip : tips?.nearest(motion?.plan.scope_tip_lps ?? this.place);
    const next = tips?.next(from, way, this.target) ?? null;
    if (next !== null) this.choose({ tip: next });
  }

  // Show what the address says: everything begins here.
  follow() {
    if (!this.ready) return;
    const { asked } = this.state;
    this.whatIfPanel.show();
    byId("nodule").value = this.facts.targets.some(({ text }) => text === asked.target) ? asked.target : "";
    byId("target-text").value = asked.target;
    byId("target-error").textContent = "";
    this.search.follow();
    if (!asked.target) this.clear();
    this.compared.follow();
  }

  clear() {
    this.exits = this.motion = this.target = this.plan = this.failure = null;
    this.planPanel.clear("Choose a target: click into a slice, or pick a nodule.");
    this.showExits();
    this.showPlan();
    this.fitImage(this.place);
  }

  // Show a layer of the reach, or words in its place.
  takeReach(layer, words = null) {
    this.reach = layer;
    this.showReach(words);
  }

  showReach(words = null) {
    if (!this.views) return;
    byId("reach-words").textContent = words ?? (this.reach ? this.reach.words() : "");
    const shown = byId("reach-scene").checked && this.reach;
    if (this.scene && (shown || this.scene.points.has("reach"))) {
      this.scene.setPoints("reach", shown ? this.reach.points() : null);
      this.redrawScene();
    }
    this.redrawSlices();
  }

  planFailed(error) {
    this.failure = error.kind;
    this.motion = this.plan = null;
    byId("target-error").textContent = ["TargetError", "FrameError"].includes(error.kind) ? error.words : "";
    this.planPanel.clear(error.words);
    say("No plan.");
    this.showPlan();
  }

  takeTarget(lps) {
    if (this.target && norm(minus(this.target, lps)) < 1e-6) return;
    this.target = [...lps];
    this.moveTo(lps);
    if (this.scene) showBall(this.scene, "target", lps);
    this.fitImage(lps);
  }

  // Fetch fine voxels around a point.
  fitImage(around) {
    this.asker.ask("image", { around }, ({ image }) => this.takeFine(image));
  }

  async takeFine(image) {
    this.image.labels[1] = await placedVolume(image.labels[0]);
    if (image.ct) this.image.ct[1] = await placedVolume(image.ct[0], image.hounsfield);
    this.redrawSlices();
  }

  // Keep what is found of a plan with what is known of it, and return it: a final one stays, and a check holds for one digest.
  async keepPlan(found, key) {
    const { plans } = this, { packed, ...rest } = found, plan = { ...plans.get(key), ...rest, key };
    if (packed) plan.motion = await Motion.of({ ...packed, scope_tip_lps: found.scope_tip_lps });
    const kept = plans.get(key)?.final ? plans.get(key) : plan;
    plans.delete(key);
    plans.set(key, kept);
    if (plans.size > KEPT_PLANS) plans.delete(plans.keys().next().value);
    return kept;
  }

  // Have a plan checked and appraised, if it was not yet.
  async appraise(plan, slot = "") {
    if (plan.final && !plan.appraisal) await this.asker.ask("appraise", { plan: plan.digest, slot }, (found) => (plan.appraisal = found));
  }

  async takePlan(found, key) {
    const plan = await this.keepPlan(found, key), isFirst = this.motion === null;
    // Another plan is asked for by now, or the masks were corrected.
    if (key !== planKey(this.state.asked) || this.plans.get(key) !== plan) return;
    this.takeTarget(plan.motion.plan.target_lps);
    Object.assign(this, { plan, motion: plan.motion });
    this.planPanel.show(plan);
    this.showPlan();
    if (isFirst && this.orbit) this.lookAtPlan();
    if (!plan.final) return;
    say("The plan is final.");
    await this.appraise(plan);
    if (this.plan === plan && plan.appraisal) this.planPanel.appraised(plan);
    this.compared.list();
  }

  takeNoPlan(found) {
    this.motion = this.plan = null;
    this.takeTarget(found.target_lps);
    this.planPanel.noPlan(found);
    say("No plan was found.");
    this.showPlan();
  }

  showPlan() {
    byId("player").hidden = !this.motion;
    this.drawn = null;
    if (this.scene && !this.target) showBall(this.scene, "target", null);
    if (this.orbit) this.fitToPlan();
    this.redraw();
  }

  showExits(words = null) {
    const { exits, state: { asked } } = this, chosen = exits?.numberOf(asked.exit);
    byId("exits-words").textContent = words ?? exits?.answer.words ?? "";
    fillRows(byId("exits"), exits?.rows(chosen, (entry) => this.choose({ exit: entry })) ?? []);
    byId("exits-more").textContent = exits?.unlisted ?? "";
    this.scene?.setPoints("exits", exits?.count ? exits.points(byId("exits-by").value, chosen) : null);
    const tip = this.tips?.place(asked.tip);
    this.scene?.setPoints("tip", tip ? { places: tip, colours: rgb("#56B4E9"), radii: 2.2 } : null);
    byId("chosen-words").textContent = asked.exit !== null ? "The plan starts from the chosen exit." : asked.tip !== null ? "The plan starts from the chosen place of the scope tip." : "Exit and scope tip are chosen by the planner.";
    byId("free").disabled = asked.exit === null && asked.tip === null;
    this.redraw();
  }

  nameOf(hit) {
    const names = { exits: `Exit ${hit.index + 1}`, tip: "Chosen place of the scope tip", preview: "Let go to choose", reach: "Voxel of the reach" };
    if (hit.key.startsWith(COMPARED)) return `Compared plan ${hit.key.slice(COMPARED.length)}`;
    return names[hit.key] || super.nameOf(hit);
  }

  // The numbers of compared plans, each at its needle.
  labels() {
    return this.compared.shown.map(({ motion, number }) => {
      const { needle } = motion.end;
      return { text: String(number), point: needle[Math.floor(needle.length / 2)] || motion.plan.target_lps, colour: planStyle(number).colour };
    });
  }

  draw() {
    const state = this.motion ? this.motion.at(this.player.position) : null;
    if (state) this.player.say(this.motion.words(state));
    if (state && this.orbit) this.goWith(state);
    const { scene, slices } = this.stale;
    this.stale = { scene: false, slices: false };
    if (scene && this.scene && this.orbit && this.views) {
      this.drawDevices(state);
      if (this.panes.isShown("scene")) this.scene.fit();
      if (state && this.panes.isShown("bronchoscopy")) this.bronchoscopy.draw(state, this.motion);
      if (this.panes.isShown("scene")) this.drawScene();
    }
    if (slices && this.views) this.drawSlices();
  }

  // Keep the tip of what plays in the middle; at the end all of the plan is.
  goWith({ position, tip }) {
    if (this.shownAtShare !== undefined && this.shownAtShare !== position) this.orbit.centre = [...(position < 1 ? tip : this.orbit.home.centre)];
    this.shownAtShare = position;
  }

  // The solid bodies are made again only where they changed.
  drawDevices(state) {
    const key = JSON.stringify([state && this.plan.digest, this.player.position, Math.round(8 * Math.log(this.orbit.distance)), this.compared.key]);
    if (this.drawn === key) return;
    this.drawn = key;
    showDevices(this.scene, this.motion && this.motion.plan, state, this.orbit.distance);
    const { shown } = this.compared;
    for (let n = 1; n <= MOST_COMPARED; n++) {
      const { motion } = shown.find(({ number }) => number === n) || {};
      showOther(this.scene, `${COMPARED}${n}`, n, motion && motion.plan, motion && motion.end, this.orbit.distance);
    }
  }

  drawSlices(isCoarse = this.hurriesSlices()) {
    this.image.overlay = byId("reach-slices").checked && this.reach ? this.reach.painter() : null;
    const of = this.motion ? deviceLines(this.motion.plan, this.motion.at(this.player.position)) : [];
    const others = this.compared.shown.flatMap(({ motion, number }) => otherLines(motion.plan, motion.end, number));
    const planes = Object.fromEntries(Object.entries(STANDARD).filter(([name]) => this.panes.isShown(name)));
    this.views.draw(planes, { lines: [...others, ...of, ...(this.stroke ? [this.stroke] : [])], target: this.target }, isCoarse);
  }

  // Take the patient again, of which the masks were corrected: what was known of it holds no longer.
  async renew() {
    await this.asker.ask("patient", {}, (facts) => this.takeFacts(facts));
    this.plans = new Map();
    this.plan = this.motion = this.search.systemKey = null;
    this.compared.rows = [];
    this.follow();
  }

  // What a test may read; while another plan is searched, the one before is still shown.
  report() {
    const { plan, exits, reach, scene } = this, isPlan = plan?.key === planKey(this.state.asked);
    return {
      ...super.report(), asked: { ...this.state.asked }, place_lps: this.place, target_lps: this.target, failure: this.failure,
      exits: exits && { count: exits.count, complete: exits.answer.complete, entries: [...exits.entries] },
      plan: isPlan ? { ...plan, motion: null, appraised: Boolean(plan.appraisal) } : null,
      tip_lps: this.motion ? this.motion.at(this.player.position).tip : null,
      compared: this.compared.rows.map(({ plan: of, hidden = false }) =>
        ({ digest: of?.digest, appraised: Boolean(of?.appraisal), hidden })),
      reach: reach && { share: reach.share, system: reach.grid.system },
      finer: Object.fromEntries(Object.entries(this.slices ?? {}).map(([name, slice]) => [name, slice.isFine])),
      place: this.placeFound ?? null, points: Object.fromEntries([...scene?.points ?? []].map(([key, { count }]) => [key, count])),
    };
  }
}

const page = new ExplorerPage();
window.lungaccessExplorer = page;
openPage(page);
