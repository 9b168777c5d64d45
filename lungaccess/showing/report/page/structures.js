// The switches: one labelled box for each thing that can be shown.

// Return a patch of a colour.
export function swatch(colour) {
  const made = document.createElement("span");
  made.className = "swatch";
  made.style.background = colour;
  made.setAttribute("aria-hidden", "true");
  return made;
}

// Add a switch to a list; changed receives whether it is on.
export function addSwitch(list, { key, name, colour, shown }, changed) {
  const item = document.createElement("li");
  const label = document.createElement("label");
  const box = document.createElement("input");
  box.type = "checkbox";
  box.checked = shown;
  box.dataset.key = key;
  label.append(box, swatch(colour), document.createTextNode(name));
  item.append(label);
  list.append(item);
  box.addEventListener("change", () => changed(box.checked));
  return box;
}

// Return the colour behind the scene, 0 to 1, as the page's style states it.
export function sceneBackground() {
  const value = getComputedStyle(document.documentElement).getPropertyValue("--scene").trim();
  return [1, 3, 5].map((n) => parseInt(value.slice(n, n + 2), 16) / 255);
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

// Connect the buttons of the views, the canvas and the letters at its edges with a camera.
export function connectViews(figure, orbit) {
  for (const button of figure.querySelectorAll("button[data-view]")) {
    button.addEventListener("click", () => orbit.look(button.dataset.view));
  }
  for (const button of figure.querySelectorAll("button[data-fit]")) {
    button.addEventListener("click", () => orbit.fit(button.dataset.fit));
  }
}

// Return whether any of an element can be seen.
export function isOnScreen(element) {
  const { top, bottom } = element.getBoundingClientRect();
  return bottom > 0 && top < window.innerHeight;
}

// Write the patient's sides at the edges of the scene.
export function showEdges(figure, orbit) {
  const names = orbit.edges();
  figure.querySelectorAll(".edge").forEach((element, n) => {
    element.textContent = names[n];
  });
  for (const button of figure.querySelectorAll("button[data-fit]")) button.hidden = !orbit.homes[button.dataset.fit];
}
