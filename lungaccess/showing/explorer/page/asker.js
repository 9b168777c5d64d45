// What the page asks over the socket to the server, and the answers, part by part; lungaccess.showing.explorer.messages says how.
import { TYPES } from "../report/decode.js";
import { byId } from "../report/structures.js";
import { say } from "./widgets.js";

const LAST = ["end", "error", "superseded"];
const LOST = { kind: "Connection", words: "The explorer has ended. Start `lungaccess view` again." };
// Answers that come soon, and are shown before a better picture is drawn.
const SOON = ["exits", "plan", "place", "appraise"];

export class Asker {
  constructor() {
    Object.assign(this, { number: 0, latest: {}, open: new Map(), shown: null });
  }

  async connect() {
    this.socket = new WebSocket(`ws://${location.host}/socket`);
    this.socket.binaryType = "arraybuffer";
    this.socket.addEventListener("message", ({ data }) => this.received(typeof data === "string" ? JSON.parse(data) : unpacked(data)));
    await new Promise((resolve, reject) => {
      this.socket.addEventListener("open", resolve);
      this.socket.addEventListener("error", () => reject(new Error("the explorer does not answer")));
    });
    this.socket.addEventListener("close", () => {
      for (const id of this.open.keys()) this.received({ id, answer: "error", error: LOST });
      say(LOST.words);
    });
  }

  // Whether an answer is awaited that comes soon.
  get awaited() {
    return [...this.open.values()].some(({ key }) => SOON.includes(key));
  }

  // Ask; of questions with the same name and slot the latest alone counts.  part receives each part of the answer with its
  // arrays, one after the other: it may be asynchronous.  failed receives an error in words, and the error.  The promise
  // resolves after them with the last message, whose "answer" is "end", "error" or "superseded".
  ask(name, values, part = () => {}, failed = say) {
    const id = ++this.number, key = values.slot ? `${name} ${values.slot}` : name;
    this.latest[key] = id;
    return new Promise((resolve, reject) => {
      this.open.set(id, { key, part, failed, resolve, reject, parts: Promise.resolve() });
      if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ ask: name, id, ...values }));
      else this.received({ id, answer: "error", error: LOST });
    });
  }

  // Take no more of what is answered to the latest question of a name.
  forget(name) {
    delete this.latest[name];
  }

  received(message) {
    const { id, answer } = message, question = this.open.get(id);
    if (!question) return;
    question.parts = question.parts.then(() => this.take(question, message));
    if (LAST.includes(answer)) question.parts.finally(() => this.open.delete(id)).then(question.resolve, question.reject);
  }

  // Take a part of an answer; the last one is what became of the question.
  async take({ key, part, failed }, message) {
    const { id, answer, error } = message, isLast = LAST.includes(answer);
    if (isLast && this.shown === id) byId("progress").hidden = true;
    if (this.latest[key] !== id) return { answer: "superseded" };
    if (answer === "progress") this.showProgress(message);
    else if (!isLast) await part(message);
    if (isLast) delete this.latest[key];
    if (error) failed(error.words, error);
    return message;
  }

  showProgress({ id, what, share }) {
    const bar = byId("progress");
    this.shown = id;
    bar.hidden = false;
    if (share === null) bar.removeAttribute("value");
    else bar.value = share;
    say(`${what[0].toUpperCase()}${what.slice(1)}${share === null ? "" : `: ${Math.round(100 * share)} %`}`);
  }
}

// Return the message of a binary frame; its arrays take the place of their descriptions.
function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const message = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const arrays = {};
  for (const { name, kind, shape, offset } of message.arrays) {
    arrays[name] = new TYPES[kind](buffer, 4 + length + offset, shape.reduce((product, n) => product * n, 1));
  }
  return { ...message, arrays };
}
