// What is changed of the system: one control for each value; what is changed is marked, what cannot be is answered beside it.
import { byId } from "../report/anatomy_page.js";

const FIELDS = { scope_diameter_mm: "scope", needle_radius_mm: "radius", needle_length_mm: "length", margin_mm: "margin" };
const OWN = { scope: null, radius: null, length: null, margin: null, fissures: null };
const SLIDER_WAIT_MS = 60;

export class WhatIfPanel {
  constructor(facts, state) {
    Object.assign(this, { facts, state, field: byId("system") });
    byId("system").replaceChildren(...facts.systems.map(({ name }) => new Option(name, name)));
  }

  get system() {
    return this.facts.systems.find(({ name }) => name === this.state.asked.system);
  }

  connect() {
    byId("what-if").addEventListener("change", ({ target }) => {
      const { id, value } = target, key = FIELDS[id];
      this.field = target;
      if (id === "system") this.set({ system: value });
      else if (id === "fissures") this.set({ fissures: { yes: true, no: false }[value] ?? null });
      else if (key && target.checkValidity()) this.setNumber(id, value);
      else if (key) this.fail(`${value || "This"} is not possible: expected is a number from ${target.min} to ${target.max} mm.`);
    });
    let waiting = null;
    byId("needle_radius_slider").addEventListener("input", ({ target: { value } }) => {
      byId("needle_radius_mm").value = value;
      clearTimeout(waiting);
      waiting = setTimeout(() => this.setNumber("needle_radius_mm", value), SLIDER_WAIT_MS);
    });
    byId("iterations").addEventListener("change", ({ target: { value } }) => this.state.set({ iterations: Number(value) }));
    byId("seed").addEventListener("change", ({ target: { value } }) => this.state.set({ seed: Math.max(0, Math.round(Number(value) || 0)) }));
    byId("reset").addEventListener("click", () => this.set(OWN));
  }

  setNumber(id, text) {
    const own = this.system ? this.system[id] : null, value = text === "" ? own : Number(text);
    this.set({ [FIELDS[id]]: own !== null && Math.abs(value - own) < 1e-9 ? null : value });
  }

  // Another system has other deployments: a chosen exit or tip is none of them.
  set(changes) {
    this.state.set({ ...changes, exit: null, tip: null });
  }

  show() {
    const { asked } = this.state, { system } = this;
    this.fail("");
    byId("system").value = asked.system;
    for (const [id, key] of Object.entries(FIELDS)) {
      const field = byId(id), own = system ? system[id] : null;
      field.value = asked[key] ?? (own === null ? "" : Number(own.toFixed(3)));
      field.disabled = own === null;
      field.classList.toggle("changed", asked[key] !== null);
    }
    const { disabled, value } = byId("needle_radius_mm");
    Object.assign(byId("needle_radius_slider"), { disabled, value });
    byId("fissures").value = asked.fissures === null ? "" : asked.fissures ? "yes" : "no";
    byId("fissures").classList.toggle("changed", asked.fissures !== null);
    byId("iterations").value = String(asked.iterations);
    byId("seed").value = String(asked.seed);
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
    const error = byId("what-if-error");
    this.field.closest("label").after(error);
    error.hidden = !words;
    error.textContent = words;
  }
}
