// From what the address states to what is shown: the system, its reach, and exits and plans of the target.
import { rgb } from "../report/vectors.js";
import { Exits } from "./exits.js";
import { ReachLayer } from "./reach_layer.js";
import { planKey, planQuestion, systemKey, whatIf } from "./state.js";
import { Tips } from "./tips.js";
import { errorWords } from "./widgets.js";

const NO_NEEDLE = "This system has no needle: its tubes go to the target themselves, and no exit is to be chosen. The reach shows what they can do.";

export class Search {
  constructor(page) {
    this.page = page;
    // When the target was clicked; and ms from there to the first exits and the first plan, and from a change of the system
    // to its reach.
    this.clicked = null;
    this.times = {};
  }

  // Count the times of the next target from now on.
  click() {
    this.clicked = performance.now();
  }

  // Bring what is shown to what the address says.
  follow() {
    const preparing = this.prepare();
    this.now = null;
    if (this.page.state.asked.target) this.seek(preparing);
  }

  // Prepare the system, then show what it reaches; resolves when its atlas is known, with the last message.
  prepare() {
    const key = systemKey(this.page.state.asked);
    if (this.systemKey !== key) {
      this.systemKey = key;
      this.preparing = this.prepareAnew();
    }
    return this.preparing;
  }

  async prepareAnew() {
    const { page } = this, began = performance.now();
    // What was painted holds for the system before.
    page.takeReach(page.reach && page.reach.outdated());
    const last = await page.asker.latest("prepare", { what_if: whatIf(page.state.asked) }, (found) => {
      page.tips = new Tips(found);
      page.whatIfPanel.prepared();
      page.showExits();
    });
    if (last.answer === "error") {
      this.systemKey = null;
      page.whatIfPanel.refuse(errorWords(last.error));
    }
    if (last.answer !== "end") return last;
    page.asker.latest("ready", { what_if: whatIf(page.state.asked) }, () => null);
    this.seekReach(began);
    return last;
  }

  async seekReach(began) {
    const { page } = this, question = { what_if: whatIf(page.state.asked), around: page.targetLps || page.place };
    const colours = Object.fromEntries(Object.entries(page.facts.reach_colours).map(([name, colour]) => [name, rgb(colour)]));
    let layer = null;
    const last = await page.asker.latest("reach", question, (part) => {
      if (part.answer === "reach grid") {
        layer = new ReachLayer(part, colours, page.reach);
        return;
      }
      layer.take(part);
      if (page.reach !== layer) this.times.reach = performance.now() - began;
      page.takeReach(layer);
    });
    if (last.answer === "error") page.takeReach(null, errorWords(last.error));
  }

  // Ask for exits and plan once the system is prepared; what is known already is shown at once.
  async seek(preparing) {
    const { page } = this, { asked } = page.state, key = planKey(asked), known = page.plans.get(key);
    const click = this.clicked || performance.now(), now = this.now = {};
    this.clicked = this.times.exits = this.times.plan = null;
    page.exits = page.failure = null;
    // What still comes of the questions before is not taken.
    for (const name of ["exits", "plan"]) page.asker.forget(name);
    if (known) page.takePlan(known, key);
    else {
      page.planPanel.clear("Searching…");
      page.say("Planning…");
    }
    const { answer, error } = await preparing;
    if (now !== this.now || answer === "superseded") return;
    if (error) {
      page.planFailed(error);
      return;
    }
    this.seekExits(asked, click);
    if (!known || !known.final) this.seekPlan(asked, key, click);
  }

  async seekExits(asked, click) {
    const { page } = this, { target, what_if } = planQuestion(asked);
    if (!page.hasNeedle) {
      page.showExits(NO_NEEDLE);
      return;
    }
    const more = asked.tip !== null && asked.exit === null ? { scope_tip: asked.tip } : {};
    const last = await page.asker.latest("exits", { target, what_if, ...more }, (found) => {
      page.exits = new Exits(found);
      page.takeTarget(found.target_lps);
      page.showExits();
      this.showFirst("exits", click);
    });
    if (last.answer !== "error") return;
    page.exits = null;
    page.showExits(errorWords(last.error));
  }

  async seekPlan(asked, key, click) {
    const { page } = this;
    const last = await page.asker.latest("plan", planQuestion(asked), async (found) => {
      if (found.answer === "no_plan") page.takeNoPlan(found);
      else {
        await page.takePlan(found, key);
        this.showFirst("plan", click);
      }
    });
    if (last.answer === "error") page.planFailed(last.error);
  }

  // Draw the first answer of a kind at once, and keep how long it took.
  showFirst(name, click) {
    if (this.times[name] !== null) return;
    this.page.redrawFast();
    this.times[name] = performance.now() - click;
  }
}
