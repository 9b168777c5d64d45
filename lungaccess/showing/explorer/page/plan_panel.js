// What is said of the plan: headline, numbers, curve, why there is none, files, and the command.
import { byId } from "../report/anatomy_page.js";
import { lineChart } from "../report/charts.js";
import { planKey, whatIf } from "./state.js";
import { errorWords, fillRows, made, mm } from "./widgets.js";

const GRADES = ["good", "fair", "unknown", "poor"];
const MOST_LIMITS = 6;
const FILES = [
  "plan.json", "report.html", "slicer.zip", "overview.png", "tree.png", "cost_over_time.png", "cost_over_time.csv", "summary.json", "system.toml",
];

export class PlanPanel {
  constructor(page) {
    this.page = page;
  }

  connect() {
    byId("export").append(...FILES.map((name) => new Option(name, name)));
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

  grade(name) {
    const box = byId("headline");
    for (const each of GRADES) box.classList.toggle(`grade-${each}`, each === name);
  }

  say(words, grade = "unknown") {
    byId("headline-text").textContent = words;
    this.grade(grade);
  }

  clear(words) {
    this.say(words);
    for (const id of ["plan-table", "limits-box", "curve", "no-plan", "plan-actions", "command-box"]) byId(id).hidden = true;
    byId("window-words").textContent = "";
  }

  searching() {
    this.clear("Searching…");
  }

  show(plan) {
    byId("no-plan").hidden = true;
    for (const id of ["plan-table", "plan-actions", "curve"]) byId(id).hidden = false;
    if (!plan.appraisal) this.say(plan.final ? "Proved by the planner; the check is running…" : "Proved by the planner, not checked yet; better plans follow…");
    const least = Object.entries(plan.clearance_mm).flatMap(([device, values]) =>
      Object.entries(values).map(([name, value]) => ({ device, name, value }))).sort((a, b) => a.value - b.value)[0];
    fillRows(byId("plan-rows"), [
      ["system", plan.system], ["scope", `to generation ${plan.generation}`], ["tubes", plan.insertions],
      ["needle", plan.needle_mm === null ? "none" : `${mm(plan.needle_mm)} in ${plan.arcs} ${plan.arcs === 1 ? "arc" : "arcs"}`],
      ["least clearance", least ? `${least.device} to ${least.name === "outside" ? "pleura" : least.name}: ${mm(least.value, 2)}` : "5 mm or more"],
      [plan.goal.words, plan.goal.value],
      ["found at", `iteration ${plan.iterations}`],
    ]);
    byId("window-words").textContent = "";
    this.drawCurve(plan);
    byId("plan-actions").hidden = !plan.final;
    byId("command-box").hidden = !plan.final;
    byId("command").textContent = plan.command;
    byId("command-note").textContent =
      `The plan is the same, byte for byte but for its times.${plan.command.includes("system.toml") ? " Export system.toml first." : ""}`;
  }

  drawCurve({ curve, goal }) {
    if ((byId("curve").hidden = !curve.length)) return;
    const xs = curve.map(([seconds]) => 1000 * seconds), ys = curve.map(([, , cost]) => cost);
    if (xs.length === 1) [xs[1], ys[1]] = [xs[0] + 1, ys[0]];
    lineChart(byId("curve"), {
      x: { name: "ms" }, y: { name: goal.loss_words, from: 0.9 * Math.min(...ys) },
      series: [{ name: "best so far", colour: "#3A9BD5", xs, ys, stairs: true }],
      top: Math.max(...ys) * 1.02,
    });
  }

  appraised(plan) {
    const { headline, limits, window: words, advice } = plan.appraisal;
    this.say([headline.text, ...advice].join(" "), headline.grade);
    byId("window-words").textContent = words;
    byId("limits-box").hidden = false;
    fillRows(byId("limits"), limits.slice(0, MOST_LIMITS).map(({ what, value, bound, side, unit, ok }) => [
      what, `${Number(value).toPrecision(3)} ${unit}`, `${side} ${Number(bound).toPrecision(3)}`,
      made("span", { className: ok ? "good" : "bad" }, ok ? "ok" : "broken"),
    ]));
  }

  noPlan({ found, remedy, reasons }) {
    this.clear("No plan was found.");
    this.grade("poor");
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
