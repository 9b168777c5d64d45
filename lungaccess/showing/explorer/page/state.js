// What the page shows, as the part of its address behind #: it can be kept, sent and undone.

// What a plan follows from; numbers are null where the system's own value holds.
export const NUMBERS = { scope: "scope_diameter_mm", radius: "needle_radius_mm", length: "needle_length_mm", margin: "margin_mm" };
export const OWN = { scope: null, radius: null, length: null, margin: null, fissures: null };
export const FREE = { exit: null, tip: null };
const START = { target: "", system: "", ...OWN, iterations: 20, seed: 0, ...FREE };
export const MOST_COMPARED = 5;

export class State {
  // Read the address; changed is called after each change, also by the buttons of the browser.
  constructor(system, changed) {
    this.first = { ...START, system };
    this.changed = changed;
    this.read();
    window.addEventListener("popstate", () => {
      this.read();
      this.changed();
    });
  }

  read() {
    const text = new URLSearchParams(location.hash.slice(1));
    this.asked = plainFrom(text, this.first);
    this.compared = text.getAll("with").slice(0, MOST_COMPARED).map((each) => plainFrom(new URLSearchParams(each), this.first));
  }

  // Change something, so that it can be undone, or as if it had been so with "replaceState".
  set(changes, how = "pushState") {
    Object.assign(this.asked, changes);
    const text = plainText(this.asked, this.first);
    for (const each of this.compared) text.append("with", plainText(each, this.first).toString());
    const address = `#${text}`;
    if (address !== location.hash) history[how](null, "", address);
    this.changed();
  }

  // Keep a list of compared plans.
  compare(list) {
    this.compared = list;
    this.set({});
  }
}

// Return what a text states for a key, null for nothing and for what is wrong.
export function valueFrom(key, text) {
  if (key === "fissures") return text === "yes" ? true : text === "no" ? false : null;
  if (key === "target" || key === "system") return text.slice(0, 200);
  return text !== "" && Number.isFinite(Number(text)) ? Number(text) : null;
}

export const textOf = (value) => (typeof value === "boolean" ? (value ? "yes" : "no") : String(value ?? ""));

// Return what is asked of a text; what it does not state, or states wrongly, is as at first.
const plainFrom = (text, first) => Object.fromEntries(Object.entries(first).map(([key, value]) =>
  [key, text.has(key) ? valueFrom(key, text.get(key)) ?? value : value]));

const plainText = (asked, first) => new URLSearchParams(Object.entries(asked)
  .filter(([key, value]) => value !== first[key] && value !== null).map(([key, value]) => [key, textOf(value)]));

// Return what of a state is changed of its system, as the server reads it.
export function whatIf(asked) {
  const made = { system: asked.system };
  for (const [key, name] of Object.entries(NUMBERS)) if (asked[key] !== null) made[name] = asked[key];
  if (asked.fissures !== null) made.fissures_allowed = asked.fissures;
  return made;
}

// Return the question of a plan.
export function planQuestion(asked) {
  const made = { target: asked.target, what_if: whatIf(asked), iterations: asked.iterations, seed: asked.seed };
  if (asked.exit !== null) made.entry = asked.exit;
  else if (asked.tip !== null) made.scope_tip = asked.tip;
  return made;
}

// Return a text that is the same for states with the same plan.
export const planKey = (asked) => JSON.stringify(planQuestion(asked));
export const systemKey = (asked) => JSON.stringify(whatIf(asked));
