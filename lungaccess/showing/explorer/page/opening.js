// The page on which a CT or a patient of this machine is chosen, segmented, and then explored.
import { byId, made } from "../report/structures.js";
import { Asker } from "./asker.js";
import { button, fillList, say } from "./widgets.js";

const GO_ON = "Go on all the same";
const asker = new Asker();
let busy = true;

// Ask, and show an error beside the folder, in which another one can be chosen.
async function ask(name, values, part) {
  busy = true;
  byId("question").hidden = true;
  byId("problem").textContent = "";
  await asker.ask(name, values, part, (words) => {
    say("Choose another folder or file.");
    byId("problem").textContent = words;
  });
  busy = false;
}

const look = (path) => ask("look", { path }, ({ path: shown, parent, folders, files, left_out: isCut }) => {
  const separator = shown.includes("\\") ? "\\" : "/", inside = (name) => `${shown.replace(/[\\/]$/, "")}${separator}${name}`;
  byId("path").value = shown;
  fillList(byId("entries"), [
    button("..", "The folder above", () => look(parent)),
    ...folders.map((name) => button(`${name}${separator}`, `Folder ${name}`, () => look(inside(name)))),
    ...files.map((name) => button(name, `Open ${name}`, () => open(inside(name)))),
    ...(isCut ? ["There are more: type the name."] : []),
  ]);
  say("Choose a folder or a file.");
});

// Show what is to be decided: sentences, and what can be done.
function decide(words, choices) {
  fillList(byId("words"), words.filter(Boolean));
  byId("choices").replaceChildren(...choices);
  byId("question").hidden = false;
  if (choices.length) say("Your decision is needed.");
}

function open(path, values = {}) {
  const again = (more) => () => open(path, { ...values, ...more });
  byId("picture").hidden = true;
  byId("choices").replaceChildren();
  ask("open", { path, ...values }, (part) => {
    const { answer, accept, thick_slices } = part;
    if (answer === "link") Object.assign(byId("picture"), { src: part.address, hidden: false });
    if (answer === "begun") decide([part.words], []);
    if (answer === "opened") location.assign("/");
    if (answer === "segmented") decide([`The masks are in ${part.folder}: look at them.`, ...part.warnings], [
      button("The masks are right: explore", "Explore", () => open(part.folder, { thick_slices: Boolean(values.thick_slices) }))]);
    if (answer === "refused") decide([part.found, `Expected: ${part.expected}`, "Whoever goes on all the same plans on masks that may be wrong; it is noted in the patient."], [
      button(GO_ON, GO_ON, again({ accept, thick_slices }))]);
    if (answer !== "series") return;
    const { uid, words, proposed, arrays: { picture } } = part, [height, width] = part.shape;
    const canvas = made("canvas", { width, height, role: "img", ariaLabel: `Middle slice of ${words}` });
    canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(picture), width, height), 0, 0);
    decide(["The folder holds several series: which one is it?"], [...byId("choices").children,
      made("button", { type: "button", className: proposed ? "proposed" : "", onclick: again({ series: uid }) }, canvas, proposed ? `Proposed: ${words}` : words)]);
  });
}

// Return the files of dropped folders, and of folders in them.
async function filesOf(entry) {
  if (entry.isFile) return [await new Promise((done, failed) => entry.file(done, failed))];
  const reader = entry.createReader(), found = [];
  for (let some = null; !some || some.length;) {
    some = await new Promise((done, failed) => reader.readEntries(done, failed));
    for (const each of some) found.push(...await filesOf(each));
  }
  return found;
}

// Open what is dropped: it is copied first, as a browser tells nobody where it lies.
async function drop(event) {
  event.preventDefault();
  const entry = event.dataTransfer.items[0]?.webkitGetAsEntry();
  if (busy || !entry) return;
  busy = true;
  const files = await filesOf(entry), plain = (name) => name.replace(/[^\w.()+-]/g, "-").replace(/^[^\w(]/, "x").slice(-150);
  const folder = `${plain(entry.name)}-${Date.now().toString(36)}`;
  let path = "";
  for (const [n, file] of files.entries()) {
    say(`Copying file ${n + 1} of ${files.length}`);
    const answer = await fetch(`/drop/${folder}/${entry.isFile ? plain(file.name) : `${n}-${plain(file.name)}`}`, { method: "PUT", body: file });
    if (!answer.ok) {
      busy = false;
      return say(`${file.name} cannot be copied: is there room in the folder in which lungaccess was started?`);
    }
    path = await answer.text();
  }
  return open(entry.isFile ? path : path.replace(/[\\/][^\\/]*$/, ""));
}

for (const kind of ["dragover", "drop"]) document.addEventListener(kind, (event) => (kind === "drop" ? drop(event) : event.preventDefault()));
byId("place").addEventListener("submit", (event) => {
  event.preventDefault();
  look(byId("path").value);
});
byId("take").addEventListener("click", () => open(byId("path").value));

window.lungaccessReport = {
  ready: asker.connect().then(() => look("")),
  state: () => ({ busy, question: byId("question").hidden ? "" : byId("question").textContent, problem: byId("problem").textContent }),
};
