// The camera that goes round the patient: by mouse, by fingers and by keys.
import { connectGestures } from "./gestures.js";
import { distanceToSee } from "./scene.js";
import { add, cross, letters, minus, norm, times, unit } from "./vectors.js";

const TURN_KEYS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
const VIEWS = { front: [0, 0], left: [Math.PI / 2, 0], right: [-Math.PI / 2, 0], back: [Math.PI, 0], feet: [0, -1.45] };

const BETTER = 1.35;

export class Orbit {
  // changed is called after each movement.
  constructor(canvas, centre, distance, changed) {
    this.homes = { all: { centre, distance } };
    this.home = this.homes.all;
    this.changed = changed;
    // Called with the event of a press that did not drag.
    this.clicked = () => {};
    this.look("front");
    connectGestures(canvas, new Map(), {
      dragged: ({ shiftKey, buttons }, [x, y]) => (shiftKey || buttons === 2 ? this.pan(x, y) : this.turn(-x * 0.008, y * 0.008)),
      pinched: (_event, factor, [x, y]) => {
        this.zoom(factor);
        this.pan(x, y);
      },
      tapped: (event) => this.clicked(event),
    });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.0012));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  // Look from a named side at what is fitted: all of the patient, or the plan.
  look(name) {
    [this.yaw, this.pitch] = VIEWS[name];
    this.comeHome();
  }

  // Name something that can be fitted: a ball in LPS mm.
  setHome(name, centre, radius) {
    this.homes[name] = { centre, distance: distanceToSee(radius) };
    this.changed();
  }

  // Bring what has a name into view, from the side we are on.
  fit(name) {
    this.home = this.homes[name] || this.homes.all;
    this.comeHome();
  }

  comeHome() {
    this.centre = [...this.home.centre];
    this.distance = this.home.distance;
    this.changed();
  }

  zoom(factor) {
    this.distance = Math.min(Math.max(this.distance * factor, 15), 4000);
    this.changed();
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
    this.changed();
  }

  pan(x, y) {
    const { right, above } = this.camera();
    const scale = this.distance * 0.0012;
    this.centre = add(this.centre, add(times(right, -x * scale), times(above, y * scale)));
    this.changed();
  }

  key(event) {
    const turn = TURN_KEYS[event.key];
    if (turn && event.shiftKey) this.pan(-turn[0] * 200, turn[1] * 200);
    else if (turn) this.turn(...turn);
    else if (event.key === "+" || event.key === "=") this.zoom(0.87);
    else if (event.key === "-") this.zoom(1.15);
    else if (event.key === "f") this.fit("plan");
    else if (event.key === "0" || event.key === "Home") {
      this.home = this.homes.all;
      this.look("front");
    }
    else return;
    event.preventDefault();
  }

  // Yaw 0 is seen from the front, so that the patient's left is on the right.
  camera() {
    const { centre, distance } = this, back = backOf(this.yaw, this.pitch), forward = times(back, -1);
    const right = unit(cross(forward, [0, 0, 1])), above = cross(right, forward);
    return { eye: add(centre, times(back, distance)), forward, up: [0, 0, 1], right, above, distance };
  }

  // The patient's sides at the edges of the picture: left, right, bottom, top.
  edges() {
    const { right, above } = this.camera();
    return [letters(times(right, -1)), letters(right), letters(times(above, -1)), letters(above)];
  }
}

// Return the direction in which one goes back from what is seen from a side.
const backOf = (yaw, pitch) => [Math.sin(yaw) * Math.cos(pitch), -Math.cos(yaw) * Math.cos(pitch), Math.sin(pitch)];

// Return the name of the side from which a line of points is seen long: the front, unless another side is much better.
export function sideOf(points) {
  const line = minus(points[points.length - 1], points[0]);
  const seen = Object.entries(VIEWS).map(([name, angles]) => [name, norm(cross(line, backOf(...angles)))]);
  const best = seen.reduce((a, b) => (b[1] > a[1] + 1e-9 ? b : a));
  return best[1] > BETTER * seen[0][1] ? best[0] : "front";
}

// Return the middle and the radius of a ball around points.
export function ballAround(points) {
  const middle = [0, 1, 2].map((axis) => {
    const values = points.map((each) => each[axis]);
    return (Math.min(...values) + Math.max(...values)) / 2;
  });
  return { centre: middle, radius: Math.max(...points.map((each) => norm(minus(each, middle)))) };
}
