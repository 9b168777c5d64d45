// The socket to the server: questions with numbers, and answers part by part; lungaccess.showing.explorer.messages says how.
import { TYPES } from "../report/decode.js";

const LAST = ["end", "error", "superseded"];
const LOST = { kind: "Connection", found: "The explorer has ended", expected: "a running lungaccess view", remedy: "Start it again" };

export class Connection {
  // Connect; lost is called when the server is gone.
  static async open(lost) {
    const made = new Connection();
    made.number = 0;
    made.waiting = new Map();
    made.socket = new WebSocket(`ws://${location.host}/socket`);
    made.socket.binaryType = "arraybuffer";
    made.socket.addEventListener("message", ({ data }) => made.received(data));
    await new Promise((resolve, reject) => {
      made.socket.addEventListener("open", resolve);
      made.socket.addEventListener("error", () => reject(new Error("the explorer does not answer")));
    });
    made.socket.addEventListener("close", () => {
      for (const [id] of made.waiting) made.finish(id, { id, answer: "error", error: LOST });
      lost();
    });
    return made;
  }

  // Ask; part receives each part of the answer with its arrays, one after the other: it may be asynchronous.  The promise
  // `done` resolves after them with the last message, whose "answer" is "end", "error" or "superseded".
  ask(ask, values, part = () => {}) {
    const id = ++this.number;
    const done = new Promise((resolve, reject) => this.waiting.set(id, { part, resolve, reject, parts: Promise.resolve() }));
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ ask, id, ...values }));
    else this.finish(id, { id, answer: "error", error: LOST });
    return { done };
  }

  received(data) {
    const message = typeof data === "string" ? JSON.parse(data) : unpacked(data);
    const waiting = this.waiting.get(message.id);
    if (!waiting) return;
    if (LAST.includes(message.answer)) this.finish(message.id, message);
    else waiting.parts = waiting.parts.then(() => waiting.part(message));
  }

  finish(id, message) {
    const { parts, resolve, reject } = this.waiting.get(id);
    this.waiting.delete(id);
    parts.then(() => resolve(message), reject);
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
