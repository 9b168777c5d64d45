// What is said of the plan: headline, numbers, advice, why there is none, files, and the command.
import { byId, made } from "../report/structures.js";
import { planKey, whatIf } from "./state.js";
import { fillList, fillRows, say } from "./widgets.js";

const MOST_LIMITS = 6;
const TO_COPY = "This browser does not let the page copy the command. Select it, and copy it by the browser's own menu.";

export class PlanPanel {
  constructor(page) {
    this.page = page;
    byId("export").addEventListener("change", ({ target }) => {
      this.export(target.value);
      target.value = "";
    });
    byId("copy").addEventListener("click", () => navigator.clipboard.writeText(byId("command").textContent)
      .then(() => say("The command is copied."), () => say(TO_COPY)));
    byId("explain").addEventListener("click", () => this.explain());
  }

  say(words, grade = "unknown") {
    byId("headline-text").textContent = words;
    byId("headline").className = `headline grade-${grade}`;
  }

  clear(words, grade) {
    this.say(words, grade);
    for (const id of ["plan-rows", "details-rows", "advice", "limits", "estimate"]) byId(id).replaceChildren();
    for (const id of ["no-plan", "plan-actions", "command-box"]) byId(id).hidden = true;
  }

  show({ final, system, goal, iterations, appraisal, way, cpu_s: cpu, risk, command }) {
    byId("no-plan").hidden = true;
    if (!appraisal) this.say(final ? "Proved by the planner; the check is running…" : "Proved by the planner, not checked yet; better plans follow…");
    fillRows(byId("plan-rows"), [
      ["Chance", appraisal ? appraisal.chance : "not estimated yet"], ["Way", way],
      ["Time", `planned in ${cpu < 0.1 ? "less than 0.1" : cpu.toFixed(1)} s of processor time. ${appraisal ? `${appraisal.window}.` : ""}`],
      ["Risk", appraisal ? appraisal.risk : risk],
    ]);
    fillRows(byId("details-rows"), [["system", system], [goal.words, goal.value], ["found at", `iteration ${iterations}`]]);
    for (const id of ["plan-actions", "command-box"]) byId(id).hidden = !final;
    byId("command").textContent = command;
    byId("command-note").textContent =
      `The plan is the same, byte for byte but for its times.${command.includes("system.toml") ? " Export system.toml first." : ""}`;
  }

  appraised(plan) {
    const { headline, limits, said, advice } = plan.appraisal;
    this.show(plan);
    this.say(said, headline.grade);
    fillList(byId("advice"), advice);
    byId("estimate").textContent = headline.text;
    fillRows(byId("limits"), limits.slice(0, MOST_LIMITS).map(({ what, value, bound, side, unit, ok }) => [
      what, `${Number(value).toPrecision(3)} ${unit}`, `${side} ${Number(bound).toPrecision(3)}`,
      made("span", { className: ok ? "good" : "bad" }, ok ? "ok" : "broken"),
    ]));
  }

  noPlan({ found, remedy, reasons }) {
    this.clear("No plan was found.", "poor");
    for (const id of ["no-plan", "explain"]) byId(id).hidden = false;
    byId("no-plan-why").textContent = [found, remedy].filter(Boolean).join(" ");
    fillRows(byId("no-plan-reasons"), Object.entries(reasons).map(([name, count]) => [name, String(count)]));
    byId("explanation").replaceChildren();
  }

  explain() {
    const { asker, state } = this.page, { asked } = state, key = planKey(asked);
    byId("explain").hidden = true;
    return asker.ask("explain", { target: asked.target, what_if: whatIf(asked), seed: asked.seed }, ({ headline, sections }) => {
      if (key !== planKey(state.asked)) return;
      byId("explanation").replaceChildren(made("p", {}, headline), ...sections.map(({ title, headings, rows }) => {
        const head = made("tr", {}, ...headings.map((text) => made("th", { scope: "col" }, text))), body = made("tbody");
        fillRows(body, rows);
        return made("div", { className: "wide" }, made("table", {}, made("caption", {}, title), made("thead", {}, head), body));
      }));
      say("Explained.");
    }, (words) => (byId("explanation").textContent = words));
  }

  // Make a file about the plan, and let the browser keep it.
  export(what) {
    return this.page.asker.ask("export", { plan: this.page.plan.digest, what, slot: what }, ({ address }) => {
      if (!address) return;
      made("a", { href: address, download: what }).click();
      say(`${what} is made.`);
    });
  }
}
