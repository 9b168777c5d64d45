// Keys, which the help lists.
import { byId } from "../report/structures.js";

// Return what follows an item in a list, or comes before it, round the ends.
function beside(items, now, step) {
  const from = step < 0 ? Math.max(now, 0) : now;
  return items.at((from + step) % items.length);
}

export function connectKeys(page) {
  const press = (id) => () => byId(id).click();
  const target = () => {
    const { facts: { targets }, state: { asked } } = page;
    if (targets.length) page.choose({ target: beside(targets, targets.findIndex(({ text }) => text === asked.target), 1).text });
  };
  const exit = (step) => () => {
    const { exits, state: { asked } } = page;
    if (exits?.count) page.choose({ exit: beside(exits.entries, exits.numberOf(asked.exit), step) });
  };
  const actions = {
    n: target, e: exit(1), E: exit(-1), "[": press("tip-back"), "]": press("tip-forward"), x: press("free"), k: press("keep"),
    v: () => page.lookAtPlan(), p: press("play"), "?": press("help-open"),
    "Ctrl z": (event) => byId(event.shiftKey ? "redo" : "undo").click(),
  };
  document.addEventListener("keydown", (event) => {
    const action = actions[event.ctrlKey || event.metaKey ? `Ctrl ${event.key.toLowerCase()}` : event.key];
    if (!action || event.defaultPrevented || event.altKey || isText(event.target) || byId("help").open) return;
    action(event);
    event.preventDefault();
  });
}

const isText = (element) => element.matches("input:not([type=checkbox]):not([type=range]), select, textarea");
