// The player of a deployment: its slider, the button that plays it, and pauses on the way.
import { byId } from "./anatomy_page.js";

const PLAY_S = 14, MOST_STEP_S = 0.25;

export class Player {
  // page: its `redraw` is called when the slider was moved, and its `show` while it plays; `pauses` returns where playing
  // stops, in thousandths of the slider.
  constructor(page, pauses = () => []) {
    Object.assign(this, { page, pauses, slider: byId("position"), button: byId("play"), playing: null });
    this.slider.addEventListener("input", () => {
      this.stop();
      page.redraw();
    });
    this.button.addEventListener("click", () => (this.playing === null ? this.play() : this.stop()));
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

  play() {
    let share = this.position >= 1 ? 0 : this.position;
    const first = share;
    const step = paced((seconds) => {
      if (this.playing === null) return;
      const before = share;
      share = Math.min(share + seconds / PLAY_S, 1);
      const pause = this.pauses().find((tick) => tick > 1000 * Math.max(before, first) + 1e-6 && tick <= 1000 * share);
      if (pause) share = pause / 1000;
      this.position = share;
      this.page.show("moving");
      if (share >= 1 || pause) this.stop();
      else this.playing = requestAnimationFrame(step);
    });
    this.button.textContent = "Pause";
    this.playing = requestAnimationFrame(step);
  }

  stop() {
    if (this.playing !== null) cancelAnimationFrame(this.playing);
    this.playing = null;
    this.button.textContent = "Play";
  }
}

// Return a step of an animation that is told the seconds since the one before: on a slow machine it is slower,
// and does not jump.
export function paced(step) {
  let last = performance.now();
  return (now) => {
    const seconds = Math.min(Math.max(now - last, 0) / 1000, MOST_STEP_S);
    last = now;
    step(seconds);
  };
}
