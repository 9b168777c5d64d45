// The player of a deployment: its slider, the button that plays it, and pauses on the way.
import { byId } from "./structures.js";

const PLAY_S = 14, MOST_STEP_S = 0.25;

export class Player {
  // page: its `redraw` is called when the slider was moved, and its `show` while it plays; `pauses` returns where playing
  // stops, in thousandths of the slider.
  constructor(page, pauses = () => []) {
    Object.assign(this, { page, pauses, slider: byId("position") });
    this.animated = new Animated(byId("play"), ["Play", "Pause"], () => this.begin());
    this.slider.addEventListener("input", () => {
      this.stop();
      page.redraw();
    });
  }

  // Where the deployment is, 0 to 1.
  get position() {
    return Number(this.slider.value) / 1000;
  }

  set position(share) {
    this.slider.value = Math.round(1000 * share);
  }

  // Say in words where it is.
  say(words) {
    this.slider.setAttribute("aria-valuetext", words);
    byId("position-words").textContent = words;
  }

  begin() {
    let share = this.position >= 1 ? 0 : this.position;
    const first = share;
    return (seconds) => {
      const before = share;
      share = Math.min(share + seconds / PLAY_S, 1);
      const pause = this.pauses().find((tick) => tick > 1000 * Math.max(before, first) + 1e-6 && tick <= 1000 * share);
      if (pause) share = pause / 1000;
      this.position = share;
      this.page.show("moving");
      return share < 1 && !pause;
    };
  }

  stop() {
    this.animated.stop();
  }
}

// An animation that a button begins and ends: begin returns a step, which is told the seconds since the one before and
// returns whether it goes on; on a slow machine it is slower, and does not jump.
export class Animated {
  constructor(button, words, begin) {
    Object.assign(this, { button, words, begin, frame: null });
    button.addEventListener("click", () => (this.frame === null ? this.play() : this.stop()));
  }

  play() {
    const step = this.begin();
    let last = performance.now();
    const next = (now) => {
      const seconds = Math.min(Math.max(now - last, 0) / 1000, MOST_STEP_S);
      last = now;
      if (step(seconds) && this.frame !== null) this.frame = requestAnimationFrame(next);
      else this.stop();
    };
    this.button.textContent = this.words[1];
    this.frame = requestAnimationFrame(next);
  }

  stop() {
    cancelAnimationFrame(this.frame);
    this.frame = null;
    [this.button.textContent] = this.words;
  }
}
