// Keys, and the help that lists them.
import { byId } from "../report/anatomy_page.js";
import { made } from "./widgets.js";

const KEYS = [
  ["n", "next nodule or target"], ["e / Shift e", "next or previous exit: plan from it"], ["[ and ]", "scope tip back and forward: plan from there"],
  ["x", "exit and tip free again"], ["k", "keep the plan to compare"], ["v", "look at the plan"], ["p", "play the deployment"],
  ["Ctrl Z, Ctrl Shift Z", "undo and redo"], ["?", "this help"],
  ["in a slice: arrows, page up and down", "move the cross by a voxel; shift moves the pictures"], ["in a slice: Enter, or a click", "make the place the target"],
  ["in 3-D: arrows, + and -, 0, f", "turn, zoom, all from the front, the plan; shift moves"], ["in 3-D: Enter, m, c", "name what is in the middle, measure from there, put the cross there"],
];

export function connectHelp() {
  byId("keys").replaceChildren(...KEYS.map(([key, words]) => made("tr", {}, made("th", { scope: "row" }, made("kbd", {}, key)), made("td", {}, words))));
  byId("help-open").addEventListener("click", () => byId("help").showModal());
  byId("help-close").addEventListener("click", () => byId("help").close());
}

export function connectKeys(page) {
  const actions = {
    n: () => nextTarget(page), e: () => nextExit(page, 1), E: () => nextExit(page, -1), "[": () => page.moveTip(-1), "]": () => page.moveTip(1),
    x: () => byId("free").click(), k: () => byId("keep").click(), v: () => page.lookAtPlan(), p: () => byId("play").click(),
    "?": () => byId("help-open").click(),
  };
  document.addEventListener("keydown", (event) => {
    if (event.key.toLowerCase() === "z" && (event.ctrlKey || event.metaKey)) {
      if (isText(event.target)) return;
      if (event.shiftKey) history.forward();
      else history.back();
      event.preventDefault();
      return;
    }
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || isText(event.target) || byId("help").open) return;
    const action = actions[event.key];
    if (!action) return;
    action();
    event.preventDefault();
  });
}

const isText = (element) => element.matches("input:not([type=checkbox]):not([type=range]), select, textarea");

function nextTarget(page) {
  const { targets } = page.facts;
  if (!targets.length) return;
  const now = targets.findIndex(({ text }) => text === page.state.asked.target);
  page.chooseTarget(targets[(now + 1) % targets.length].text);
}

function nextExit(page, step) {
  const { exits, state: { asked } } = page;
  if (!exits || !exits.count) return;
  const now = exits.numberOf(asked.exit);
  page.chooseExit(exits.entries[(now < 0 ? (step > 0 ? 0 : exits.count - 1) : now + step + exits.count) % exits.count]);
}
