// Up to five plans beside each other: a table, and all of them in 3-D and in the slices.
import { planStyle } from "../report/colours.js";
import { byId, made, swatch } from "../report/structures.js";
import { MOST_COMPARED, planKey, planQuestion } from "./state.js";
import { button, fillRows, mm, say } from "./widgets.js";

export class Compared {
  constructor(page) {
    Object.assign(this, { page, rows: [] });
    byId("keep").addEventListener("click", () => this.keep());
  }

  // The plans that are drawn: all but those that are hidden, and the one that is shown anyway.
  get shown() {
    return this.rows.filter(({ plan, hidden }) => plan?.motion && plan !== this.page.plan && !hidden)
      .map(({ plan: { motion }, number }) => ({ motion, number }));
  }

  get key() {
    return this.shown.map(({ motion, number }) => `${number} ${motion.plan.digest}`).join(" ");
  }

  keep() {
    const { state, plan } = this.page;
    if (!plan) return;
    if (state.compared.some((asked) => planKey(asked) === planKey(state.asked))) say("This plan is kept already.");
    else if (state.compared.length >= MOST_COMPARED) say(`${MOST_COMPARED} plans are kept: remove one first.`);
    else state.compare([...state.compared, { ...state.asked }]);
  }

  // Bring the rows to what the address says, and plan again what is not known.
  follow() {
    const before = new Map(this.rows.map((row) => [row.key, row]));
    this.rows = this.page.state.compared.map((asked, n) => {
      const key = planKey(asked);
      return Object.assign(before.get(key) ?? { plan: this.page.plans.get(key) }, { asked, key, number: n + 1 });
    });
    this.list();
    this.fill();
  }

  async fill() {
    if (this.filling) return;
    this.filling = true;
    const { page } = this, isMissing = ({ tried, plan }) => !tried && !(plan && plan.final && plan.appraisal);
    for (let row = this.rows.find(isMissing); row; row = this.rows.find(isMissing)) {
      const { key, asked } = row;
      row.tried = true;
      row.plan = page.plans.get(key);
      if (!row.plan || !row.plan.final) {
        const { answer } = await page.asker.ask("plan", { ...planQuestion(asked), slot: "compare" }, async (found) => {
          if (found.answer === "no_plan") row.error = found.found;
          else row.plan = await page.keepPlan(found, key);
        }, (words) => (row.error = words));
        row.tried = answer !== "superseded";
      }
      if (row.plan) await page.appraise(row.plan, "compare");
      this.list();
    }
    this.filling = false;
  }

  list() {
    fillRows(byId("compare"), this.rows.map((row) => this.cells(row)));
    this.page.redraw();
  }

  cells(row) {
    const { asked, plan, number, error, hidden } = row, { state } = this.page;
    const box = made("input", { type: "checkbox", checked: !hidden, ariaLabel: `Show plan ${number}`, onchange: () => {
      row.hidden = !box.checked;
      this.page.redraw();
    } });
    const system = plan ? plan.system : asked.system, from = asked.exit !== null ? ", from an exit" : asked.tip !== null ? ", from a tip" : "";
    const open = button(`${number}: ${asked.target.replaceAll(",", ", ")}; ${system}${from}`, `Show plan ${number} again`, () => state.set({ ...asked }));
    const remove = button("✕", `Remove plan ${number}`, () => state.compare(state.compared.toSpliced(number - 1, 1)));
    const chance = plan && (plan.appraisal ? (plan.appraisal.accepted ? plan.appraisal.chance : "refused") : "not checked");
    const cells = plan ? [chance, mm(plan.needle_mm, 0), mm(plan.least_mm)] : [error || "…", "", ""];
    return [made("span", {}, box, swatch(planStyle(number).colour), open), ...cells, remove];
  }
}
