// What is said of the plan: headline, numbers, advice, why there is none, files, and the command.
import { byId } from "../report/anatomy_page.js";
import { made } from "../report/structures.js";
import { planKey, whatIf } from "./state.js";
import { errorWords, fillRows } from "./widgets.js";

const MOST_LIMITS = 6;

export class PlanPanel {
  constructor(page) {
    this.page = page;
  }

  connect() {
    byId("export").addEventListener("change", ({ target }) => {
      const what = target.value;
      target.value = "";
      if (what) this.export(what);
    });
    byId("keep").addEventListener("click", () => this.page.compared.keep());
    byId("copy").addEventListener("click", () => navigator.clipboard.writeText(byId("command").textContent).then(
      () => this.page.say("The command is copied."),
      () => this.page.say("This browser does not let the page copy the command. Select it, and copy it by the browser's own menu.")));
    byId("explain").addEventListener("click", () => this.explain());
  }

  say(words, grade = "unknown") {
    byId("headline-text").textContent = words;
    byId("headline").className = `headline grade-${grade}`;
  }

  clear(words, grade) {
    this.say(words, grade);
    for (const id of ["plan-table", "details-table", "no-plan", "plan-actions", "command-box"]) byId(id).hidden = true;
    for (const id of ["advice", "limits"]) byId(id).replaceChildren();
    byId("estimate").textContent = "";
  }

  show(plan) {
    const { final, system, goal, iterations, appraisal } = plan;
    byId("no-plan").hidden = true;
    for (const id of ["plan-table", "details-table"]) byId(id).hidden = false;
    if (!appraisal) this.say(final ? "Proved by the planner; the check is running…" : "Proved by the planner, not checked yet; better plans follow…");
    fillRows(byId("plan-rows"), [
      ["Chance", appraisal ? appraisal.chance : "not estimated yet"], ["Way", plan.way],
      ["Time", `planned in ${plan.cpu_s < 0.1 ? "less than 0.1" : plan.cpu_s.toFixed(1)} s of processor time. ${appraisal ? `${appraisal.window}.` : ""}`],
      ["Risk", appraisal ? appraisal.risk : plan.risk],
    ]);
    fillRows(byId("details-rows"), [["system", system], [goal.words, goal.value], ["found at", `iteration ${iterations}`]]);
    for (const id of ["plan-actions", "command-box"]) byId(id).hidden = !final;
    byId("command").textContent = plan.command;
    byId("command-note").textContent =
      `The plan is the same, byte for byte but for its times.${plan.command.includes("system.toml") ? " Export system.toml first." : ""}`;
  }

  appraised(plan) {
    const { headline, limits, said, advice } = plan.appraisal;
    this.show(plan);
    this.say(said, headline.grade);
    byId("advice").replaceChildren(...advice.map((words) => made("li", {}, words)));
    byId("estimate").textContent = headline.text;
    fillRows(byId("limits"), limits.slice(0, MOST_LIMITS).map(({ what, value, bound, side, unit, ok }) => [
      what, `${Number(value).toPrecision(3)} ${unit}`, `${side} ${Number(bound).toPrecision(3)}`,
      made("span", { className: ok ? "good" : "bad" }, ok ? "ok" : "broken"),
    ]));
  }

  noPlan({ found, remedy, reasons }) {
    this.clear("No plan was found.", "poor");
    byId("no-plan").hidden = false;
    byId("no-plan-why").textContent = [found, remedy].filter(Boolean).join(" ");
    fillRows(byId("no-plan-reasons"), Object.entries(reasons).map(([name, count]) => [name, String(count)]));
    byId("explain").hidden = false;
    byId("explanation").replaceChildren();
  }

  async explain() {
    const { page } = this, { asked } = page.state, key = planKey(asked);
    byId("explain").hidden = true;
    const last = await page.asker.latest("explain", { target: asked.target, what_if: whatIf(asked), seed: asked.seed }, ({ headline, sections }) => {
      if (key !== planKey(page.state.asked)) return;
      byId("explanation").replaceChildren(made("p", {}, headline), ...sections.map(({ title, headings, rows }) => {
        const head = made("thead", {}, made("tr", {}, ...headings.map((text) => made("th", { scope: "col" }, text))));
        const body = made("tbody");
        fillRows(body, rows);
        return made("div", { className: "wide" }, made("table", {}, made("caption", {}, title), head, body));
      }));
      page.say("Explained.");
    });
    if (last.answer === "error") byId("explanation").textContent = errorWords(last.error);
  }

  async export(what) {
    const { plan } = this.page;
    let address = null;
    const last = await this.page.connection.ask("export", { plan: plan.digest, what, slot: what }, (message) => {
      if (message.answer === "link") address = message.address;
      else this.page.asker.showProgress(message.answer === "progress" ? message : null);
    }).done;
    this.page.asker.showProgress(null);
    if (last.answer !== "end" || !address) {
      this.page.say(last.error ? errorWords(last.error) : `${what} was not made.`);
      return;
    }
    made("a", { href: address, download: what }).click();
    this.page.say(`${what} is made.`);
    this.exported = { what, address };
  }
}
