// What the page asks: of each kind the latest question alone counts, and its progress is shown.
import { byId } from "../report/anatomy_page.js";
import { errorWords } from "./widgets.js";

// Answers that come soon, and are shown before a better picture is drawn.
const SOON = ["exits", "plan", "place", "appraise"];

export class Asker {
  // say shows words about what is going on.
  constructor(connection, say) {
    Object.assign(this, { connection, say, numbers: {}, awaited: 0 });
  }

  // Ask, and say an error where that is the answer; resolves with the last message.
  async asked(ask, values, part) {
    const last = await this.connection.ask(ask, values, part).done;
    if (last.answer === "error") this.say(errorWords(last.error));
    return last;
  }

  // Ask so that a later question with the same name takes the place of this one.
  async latest(name, values, part) {
    this.forget(name);
    const number = this.numbers[name], isLatest = () => this.numbers[name] === number;
    const counts = SOON.includes(name) ? 1 : 0;
    this.awaited += counts;
    try {
      const last = await this.connection.ask(name, values, (message) => {
        if (!isLatest()) return null;
        return message.answer === "progress" ? this.showProgress(message) : part(message);
      }).done;
      if (!isLatest()) return { answer: "superseded" };
      this.showProgress(null);
      return last;
    } finally {
      this.awaited -= counts;
    }
  }

  // Take no more of what is answered to the latest question of a name.
  forget(name) {
    this.numbers[name] = (this.numbers[name] || 0) + 1;
  }

  showProgress(message) {
    const bar = byId("progress");
    bar.hidden = message === null;
    if (!message) return;
    if (message.share === null) bar.removeAttribute("value");
    else bar.value = message.share;
    const share = message.share === null ? "" : `: ${Math.round(100 * message.share)} %`;
    this.say(`${message.what[0].toUpperCase()}${message.what.slice(1)}${share}`);
  }
}
