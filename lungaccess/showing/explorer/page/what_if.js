// What is changed of the system: one control for each value, and what is changed is marked.
import { byId } from "../report/anatomy_page.js";

const FIELDS = { scope_diameter_mm: "scope", needle_radius_mm: "radius", needle_length_mm: "length", margin_mm: "margin" };
const SLIDER_WAIT_MS = 60;

export class WhatIfPanel {
  constructor(facts, state) {
    this.facts = facts;
    this.state = state;
    byId("system").replaceChildren(...facts.systems.map(({ name }) => new Option(name, name)));
  }

  get system() {
    return this.facts.systems.find(({ name }) => name === this.state.asked.system);
  }

  connect() {
    byId("system").addEventListener("change", (event) => this.set({ system: event.target.value }));
    for (const [id, key] of Object.entries(FIELDS)) {
      byId(id).addEventListener("change", ({ target: { value } }) => this.setNumber(id, key, value === "" ? null : Number(value)));
    }
    let waiting = null;
    byId("needle_radius_slider").addEventListener("input", ({ target: { value } }) => {
      byId("needle_radius_mm").value = value;
      clearTimeout(waiting);
      waiting = setTimeout(() => this.setNumber("needle_radius_mm", "radius", Number(value)), SLIDER_WAIT_MS);
    });
    byId("fissures").addEventListener("change", ({ target: { value } }) => this.set({ fissures: { yes: true, no: false }[value] ?? null }));
    byId("iterations").addEventListener("change", ({ target: { value } }) => this.state.set({ iterations: Number(value) }));
    byId("seed").addEventListener("change", ({ target: { value } }) => this.state.set({ seed: Math.max(0, Math.round(Number(value) || 0)) }));
    byId("reset").addEventListener("click", () => this.set({ scope: null, radius: null, length: null, margin: null, fissures: null }));
  }

  setNumber(id, key, value) {
    const own = this.system ? this.system[id] : null;
    this.set({ [key]: value === null || (own !== null && Math.abs(value - own) < 1e-9) ? null : value });
  }

  // Another system has other deployments: a chosen exit or tip is none of them.
  set(changes) {
    this.state.set({ ...changes, exit: null, tip: null });
  }

  show() {
    const { asked } = this.state, { system } = this;
    byId("system").value = asked.system;
    for (const [id, key] of Object.entries(FIELDS)) {
      const field = byId(id), own = system ? system[id] : null;
      field.value = asked[key] ?? (own === null ? "" : Number(own.toFixed(3)));
      field.disabled = own === null;
      field.classList.toggle("changed", asked[key] !== null);
    }
    const slider = byId("needle_radius_slider");
    slider.disabled = byId("needle_radius_mm").disabled;
    slider.value = byId("needle_radius_mm").value;
    byId("fissures").value = asked.fissures === null ? "" : asked.fissures ? "yes" : "no";
    byId("fissures").classList.toggle("changed", asked.fissures !== null);
    byId("iterations").value = String(asked.iterations);
    byId("seed").value = String(asked.seed);
  }

  prepared(found) {
    byId("system-words").textContent = `${found.system}: ${found.deployments} deployments`;
  }

  fail(words) {
    byId("what-if-error").hidden = !words;
    byId("what-if-error").textContent = words;
  }
}
