// Up to five plans beside each other: a table, and all of them in 3-D and in the slices.
import { byId } from "../report/anatomy_page.js";
import { planStyle } from "../report/colours.js";
import { Motion } from "../report/motion.js";
import { made } from "../report/structures.js";
import { MOST_COMPARED, planKey, planQuestion } from "./state.js";
import { button, errorWords, fillRows, mm } from "./widgets.js";

export class Compared {
  constructor(page) {
    this.page = page;
    this.rows = [];
    this.hidden = new Set();
  }

  // The plans that are drawn: all but those that are hidden, and the one that is shown anyway.
  get shown() {
    const { plan } = this.page;
    return this.rows.filter((row) => row.plan && row.plan.motion && !this.hidden.has(row.key) && row.plan !== plan)
      .map(({ plan: { motion }, number }) => ({ motion, number }));
  }

  get key() {
    return this.shown.map(({ motion, number }) => `${number} ${motion.plan.digest}`).join(" ");
  }

  keep() {
    const { state, plan } = this.page;
    if (!plan) return;
    if (state.compared.some((asked) => planKey(asked) === planKey(state.asked))) this.page.say("This plan is kept already.");
    else if (state.compared.length >= MOST_COMPARED) this.page.say(`${MOST_COMPARED} plans are kept: remove one first.`);
    else state.compare([...state.compared, { ...state.asked }]);
  }

  // Bring the rows to what the address says, and plan again what is not known.
  follow() {
    const before = new Map(this.rows.map((row) => [row.key, row]));
    this.rows = this.page.state.compared.map((asked, n) => {
      const key = planKey(asked);
      return { plan: this.page.plans.get(key), ...before.get(key), asked, key, number: n + 1 };
    });
    this.list();
    this.fill();
  }

  async fill() {
    if (this.filling) return;
    this.filling = true;
    for (let row = this.missing(); row; row = this.missing()) {
      row.tried = true;
      const known = this.page.plans.get(row.key);
      if (known && known.final) row.plan = known;
      else {
        const last = await this.page.connection.ask("plan", { ...planQuestion(row.asked), slot: "compare" }, async (found) => {
          if (found.answer === "no_plan") row.error = found.found;
          if (found.answer !== "plan") return;
          row.plan = { ...(row.plan || {}), ...found };
          if (found.packed) row.plan.motion = await Motion.of({ ...found.packed, scope_tip_lps: found.scope_tip_lps });
        }).done;
        if (last.answer === "superseded") row.tried = false;
        if (last.answer === "error") row.error = errorWords(last.error);
        if (row.plan && row.plan.final) this.page.plans.set(row.key, row.plan);
      }
      if (row.plan && !row.plan.appraisal) {
        await this.page.connection.ask("appraise", { plan: row.plan.digest, slot: "compare" }, (found) => {
          row.plan.appraisal = found;
        }).done;
      }
      this.list();
    }
    this.filling = false;
  }

  missing() {
    return this.rows.find((row) => !row.tried && !(row.plan && row.plan.final && row.plan.appraisal));
  }

  list() {
    byId("compare-table").hidden = !this.rows.length;
    byId("compare-none").hidden = this.rows.length > 0;
    fillRows(byId("compare"), this.rows.map((row, n) => this.row(row, n)));
    this.page.redraw();
  }

  row({ key, asked, plan, number, error }, n) {
    const swatch = made("span", { className: "swatch", style: `background: ${planStyle(number).colour}` });
    const box = made("input", { type: "checkbox", checked: !this.hidden.has(key), ariaLabel: `Show plan ${n + 1}`, onchange: ({ target }) => {
      this.hidden[target.checked ? "delete" : "add"](key);
      this.page.redraw();
    } });
    const system = plan ? plan.system : asked.system, from = asked.exit !== null ? ", from an exit" : asked.tip !== null ? ", from a tip" : "";
    const open = button(`${number}: ${asked.target.replaceAll(",", ", ")}; ${system}${from}`, `Show plan ${n + 1} again`, () => this.page.state.set({ ...asked }));
    const remove = button("✕", `Remove plan ${n + 1}`, () => this.page.state.compare(this.page.state.compared.filter((_, k) => k !== n)));
    const chance = plan && (plan.appraisal ? (plan.appraisal.accepted ? plan.appraisal.chance : "refused") : "not checked");
    const cells = plan ? [chance, mm(plan.needle_mm, 0), mm(plan.least_mm)] : [error || "…", "", ""];
    return [made("span", {}, box, swatch, open), ...cells, remove];
  }

  report() {
    return this.rows.map(({ key, plan, error }) => ({
      key, digest: plan ? plan.digest : null, appraised: Boolean(plan && plan.appraisal), hidden: this.hidden.has(key), error: error || null,
    }));
  }
}
