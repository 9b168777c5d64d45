// What is changed of the system and the search: a field for each value of the address; what is changed is marked, what cannot
// be is answered beside it.
import { byId } from "../report/structures.js";
import { FREE, NUMBERS, OWN, textOf, valueFrom } from "./state.js";

const SLIDER_WAIT_MS = 60;

export class WhatIfPanel {
  constructor(facts, state) {
    Object.assign(this, { facts, state, field: byId("system"), fields: document.querySelectorAll(".fields [name]") });
    byId("system").replaceChildren(...facts.systems.map(({ name }) => new Option(name)));
  }

  get system() {
    return this.facts.systems.find(({ name }) => name === this.state.asked.system);
  }

  // Return the system's own value of a number, null if it has none; undefined for what is no number of a system.
  ownOf(key) {
    return key in NUMBERS ? this.system?.[NUMBERS[key]] ?? null : undefined;
  }

  connect() {
    let waiting = null;
    for (const field of this.fields) {
      const isSlider = field.type === "range";
      field.addEventListener(isSlider ? "input" : "change", () => {
        clearTimeout(waiting);
        if (isSlider) waiting = setTimeout(() => this.take(field), SLIDER_WAIT_MS);
        else this.take(field);
      });
    }
    byId("reset").addEventListener("click", () => this.set(OWN));
  }

  // Take over what a field states; what is the system's own value is no change.
  take(field) {
    const { name, value, title } = field, stated = valueFrom(name, value), own = this.ownOf(name);
    this.field = field;
    if (!field.checkValidity()) this.fail(`${value || "This"} is not possible: expected is ${title}.`);
    else this.set({ [name]: Math.abs(stated - own) < 1e-9 ? null : stated });
  }

  // Another system has other deployments: a chosen exit or tip is none of them.
  set(changes) {
    const isSystem = Object.keys(changes).some((key) => key === "system" || key in OWN);
    this.state.set({ ...changes, ...(isSystem && FREE) });
  }

  show() {
    const { asked } = this.state;
    this.fail("");
    for (const field of this.fields) {
      const value = asked[field.name], own = this.ownOf(field.name);
      field.value = textOf(value ?? (own ? Number(own.toFixed(3)) : own));
      field.disabled = own === null;
      field.classList.toggle("changed", field.name in OWN && value !== null);
    }
  }

  // The system is prepared: what is refused from now on gives way to it.
  prepared() {
    const { asked } = this.state;
    this.possible = Object.fromEntries(["system", ...Object.keys(OWN)].map((key) => [key, asked[key]]));
  }

  // Say why the system cannot be changed so, beside what was changed, and go back to the one before.
  refuse(words) {
    const { possible } = this;
    this.possible = null;
    if (possible) this.state.set(possible, "replaceState");
    this.fail(words);
  }

  fail(words) {
    this.field.closest("label").after(byId("what-if-error"));
    byId("what-if-error").textContent = words;
  }
}
