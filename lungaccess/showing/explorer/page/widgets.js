// Small parts of the page: buttons, tables, and words.
import { byId, made } from "../report/structures.js";

// Show words about what is going on.
export const say = (words) => (byId("status").textContent = words);

export const button = (text, name, press, attributes = {}) =>
  made("button", { type: "button", ariaLabel: name, onclick: press, ...attributes }, text);

// Fill a table body with rows of cells, each text or an element; the first cell of a row is its heading.
export function fillRows(body, rows) {
  body.replaceChildren(...rows.map(([first, ...cells]) =>
    made("tr", {}, made("th", { scope: "row" }, first), ...cells.map((cell) => made("td", {}, cell ?? "")))));
}

// Fill a list with items, each text or elements.
export const fillList = (list, items) => list.replaceChildren(...items.map((item) => made("li", {}, item)));

// Return the item with the least cost, null if none has one.
export function leastOf(items, costOf) {
  const costs = items.map(costOf), least = Math.min(...costs);
  return least < Infinity ? items[costs.indexOf(least)] : null;
}

export const mm = (value, digits = 1) => (value === null || value === undefined ? "" : `${value.toFixed(digits)} mm`);
export const lpsText = (point) => `lps:${point.map((value) => Number(value.toFixed(1))).join(",")}`;
