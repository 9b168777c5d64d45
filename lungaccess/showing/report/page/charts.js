// Line charts as SVG, with a cursor.
import { made } from "./structures.js";

const SVG = "http://www.w3.org/2000/svg";
const SIZE = { width: 520, height: 270, left: 50, right: 14, top: 12, bottom: 44 };

function element(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  if (parent) parent.append(made);
  return made;
}

// Return about five round numbers between low and high.
export function ticks(low, high) {
  const raw = (high - low) / 5 || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw * 0.999);
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) found.push(+(n * step).toPrecision(10));
  return found;
}

// Draw series { name, colour, dash, xs, ys, stairs } into a figure; returns a function that moves the cursor.
// Values below 0 are left out of a line. spans: { from, to, name } are shaded; steps: a name drawn as a mark.
export function lineChart(figure, { x, y, series, top, spans = [], marks = [] }) {
  const svg = element("svg", { viewBox: `0 0 ${SIZE.width} ${SIZE.height}`, role: "img" });
  const xs = series.flatMap((each) => Array.from(each.xs));
  const low = Math.min(...xs), high = Math.max(...xs, low + 1e-9);
  const most = top || 1.08 * Math.max(...series.flatMap((each) => Array.from(each.ys)), 1e-9);
  const least = y.from || 0;
  const px = (value) => SIZE.left + ((value - low) / (high - low)) * (SIZE.width - SIZE.left - SIZE.right);
  const floor = SIZE.height - SIZE.bottom, width = SIZE.width - SIZE.left - SIZE.right;
  const py = (value) => floor - ((value - least) / (most - least)) * (floor - SIZE.top);
  for (const span of spans) {
    const box = { x: px(span.from), width: Math.max(px(span.to) - px(span.from), 0), y: SIZE.top, height: floor - SIZE.top };
    element("rect", { ...box, class: "span" }, svg);
  }
  for (const value of ticks(least, most)) {
    element("line", { x1: SIZE.left, x2: SIZE.width - SIZE.right, y1: py(value), y2: py(value), class: "grid" }, svg);
    element("text", { x: SIZE.left - 7, y: py(value) + 4, "text-anchor": "end" }, svg, value);
  }
  for (const value of ticks(low, high)) {
    element("text", { x: px(value), y: floor + 17, "text-anchor": "middle" }, svg, value);
  }
  element("line", { x1: SIZE.left, x2: SIZE.width - SIZE.right, y1: floor, y2: floor, class: "axis" }, svg);
  element("text", { x: (SIZE.left + SIZE.width) / 2, y: SIZE.height - 8, "text-anchor": "middle" }, svg, x.name);
  element("text", { x: 13, y: floor / 2, "text-anchor": "middle", transform: `rotate(-90 13 ${floor / 2})` }, svg, y.name);
  for (const mark of marks) {
    element("line", { x1: px(mark.at), x2: px(mark.at), y1: SIZE.top, y2: floor, class: "mark" }, svg);
    element("text", { x: px(mark.at) + 4, y: SIZE.top + 10 }, svg, mark.name);
  }
  // What is above the top is cut off.
  const frame = { x: SIZE.left, y: SIZE.top, width, height: floor - SIZE.top };
  const inner = element("svg", { ...frame, viewBox: Object.values(frame).join(" "), style: `width: ${width}px; height: ${frame.height}px` }, svg);
  for (const each of series) {
    const style = { fill: "none", stroke: each.colour, "stroke-width": each.width || 2.2, "stroke-dasharray": each.dash || "" };
    element("path", { d: pathOf(each, px, py), ...style, class: each.className || "" }, inner);
  }
  const cursor = element("line", { y1: SIZE.top, y2: floor, class: "cursor", visibility: "hidden" }, svg);
  figure.querySelectorAll("svg, ul").forEach((old) => old.remove());
  svg.setAttribute("aria-label", described(figure, series));
  figure.append(svg, legend(series));
  return (value) => {
    const inside = value >= low && value <= high;
    cursor.setAttribute("visibility", inside ? "visible" : "hidden");
    if (!inside) return;
    cursor.setAttribute("x1", px(value));
    cursor.setAttribute("x2", px(value));
  };
}

function pathOf({ xs, ys, stairs }, px, py) {
  let text = "";
  let pen = "M";
  for (let n = 0; n < xs.length; n++) {
    if (ys[n] < 0) {
      pen = "M";
      continue;
    }
    if (stairs && pen === "L") text += `L${px(xs[n]).toFixed(1)} ${py(ys[n - 1]).toFixed(1)}`;
    text += `${pen}${px(xs[n]).toFixed(1)} ${py(ys[n]).toFixed(1)}`;
    pen = "L";
  }
  return text;
}

function described(figure, series) {
  const title = figure.querySelector("figcaption").textContent;
  const ranges = series.map(({ name, ys }) => {
    const values = Array.from(ys).filter((value) => value >= 0);
    return values.length ? `${name} ${Math.min(...values).toPrecision(3)} to ${Math.max(...values).toPrecision(3)}` : name;
  });
  return `${title}: ${ranges.join("; ")}`;
}

function legend(series) {
  return made("ul", { className: "legend" }, ...series.map(({ name, colour, dash }) => {
    const sample = element("svg", { viewBox: "0 0 34 8", class: "sample", "aria-hidden": "true" });
    element("line", { x1: 0, x2: 34, y1: 4, y2: 4, stroke: colour, "stroke-width": 3, "stroke-dasharray": dash || "" }, sample);
    return made("li", {}, sample, name);
  }));
}
