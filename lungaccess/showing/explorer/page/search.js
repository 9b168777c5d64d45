// From what the address states to what is shown: the system, its reach, and exits and plans of the target.
import { Exits, Tips } from "./exits.js";
import { ReachLayer } from "./reach_layer.js";
import { planKey, planQuestion, systemKey, whatIf } from "./state.js";
import { say } from "./widgets.js";

const NO_NEEDLE = "This system has no needle: its tubes go to the target themselves, and no exit is to be chosen. The reach shows what they can do.";

export class Search {
  constructor(page) {
    this.page = page;
  }

  // Bring what is shown to what the address says.
  follow() {
    const { asked } = this.page.state, key = systemKey(asked);
    if (this.systemKey !== key) this.preparing = this.prepare(whatIf(asked));
    this.systemKey = key;
    this.now = null;
    if (asked.target) this.seek({ ...asked });
  }

  // Prepare the system, then show what it reaches; resolves when its atlas is known, with the last message.
  async prepare(what_if) {
    const { page } = this, { asker } = page;
    // What was painted holds for the system before.
    page.takeReach(page.reach && page.reach.outdated());
    const last = await asker.ask("prepare", { what_if }, (found) => {
      page.tips = new Tips(found);
      page.whatIfPanel.prepared();
      page.showExits();
    }, (words) => {
      this.systemKey = null;
      page.whatIfPanel.refuse(words);
    });
    if (last.answer !== "end") return last;
    asker.ask("ready", { what_if });
    let layer = null;
    asker.ask("reach", { what_if, around: page.target || page.place }, (part) => {
      if (part.answer === "reach grid") layer = new ReachLayer(part, page.reach);
      else page.takeReach(layer.take(part));
    }, (words) => page.takeReach(null, words));
    return last;
  }

  // Ask for exits and plan once the system is prepared; what is known already is shown at once.
  async seek(asked) {
    const { page, preparing } = this, key = planKey(asked), known = page.plans.get(key), now = this.now = {};
    page.exits = page.failure = null;
    // What still comes of the questions before is not taken.
    for (const name of ["exits", "plan"]) page.asker.forget(name);
    if (known) page.takePlan(known, key);
    else {
      page.planPanel.clear("Searching…");
      say("Planning…");
    }
    const { answer, error } = await preparing;
    if (now !== this.now || answer === "superseded") return;
    if (error) {
      page.planFailed(error);
      return;
    }
    this.seekExits(asked);
    if (known && known.final) return;
    page.asker.ask("plan", planQuestion(asked), async (found) => {
      if (found.answer === "no_plan") page.takeNoPlan(found);
      else await page.takePlan(found, key);
      page.redrawFast();
    }, (_, failure) => page.planFailed(failure));
  }

  seekExits(asked) {
    const { page } = this, { target, what_if, scope_tip } = planQuestion(asked);
    if (page.whatIfPanel.system?.needle_length_mm === null) {
      page.showExits(NO_NEEDLE);
      return;
    }
    page.asker.ask("exits", { target, what_if, scope_tip }, (found) => {
      page.exits = new Exits(found);
      page.takeTarget(found.target_lps);
      page.showExits();
      page.redrawFast();
    }, (words) => {
      page.exits = null;
      page.showExits(words);
    });
  }
}
