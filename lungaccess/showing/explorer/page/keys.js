// Keys, and the help, which lists them.
import { byId } from "../report/anatomy_page.js";

export function connectHelp() {
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
