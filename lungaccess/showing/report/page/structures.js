// Elements of the page, and its switches: one labelled box for each thing that can be shown.

export const byId = (id) => document.getElementById(id);

// Return the transform that shifts an element by pixels of the page.
export const shiftBy = (px) => `translate(${px.map((each) => `${each.toFixed(1)}px`)})`;

// Return an element with properties or attributes, listeners ("on" and a name) and content; text is never markup.
export function made(name, attributes = {}, ...content) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key in element && key !== "list") element[key] = value;
    else element.setAttribute(key, value);
  }
  element.append(...content);
  return element;
}

// Return a patch of a colour.
export const swatch = (colour) => made("span", { className: "swatch", ariaHidden: "true", style: `background: ${colour}` });

// Add a switch to a list; changed receives whether it is on.
export function addSwitch(list, { key, name, colour, shown }, changed) {
  const box = made("input", { type: "checkbox", checked: shown, "data-key": key, onchange: () => changed(box.checked) });
  list.append(made("li", {}, made("label", {}, box, swatch(colour), name)));
  return box;
}

// Call a function at most once for each picture of the screen; `now` calls it at once, with true, and no call waits then.
export function oncePerFrame(task) {
  let waiting = null;
  const later = () => {
    waiting ??= requestAnimationFrame(() => {
      waiting = null;
      task(false);
    });
  };
  later.now = () => {
    if (waiting !== null) cancelAnimationFrame(waiting);
    waiting = null;
    task(true);
  };
  return later;
}
