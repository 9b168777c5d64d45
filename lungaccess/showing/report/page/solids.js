// Tubes around lines, and balls, as triangles with a colour at each vertex.
import { add, cross, dot, minus, norm, times, unit } from "./vectors.js";

// Collects triangles of solid bodies, which are round by so many sides.
export class Solids {
  constructor(sides = 14) {
    this.sides = sides;
    this.places = [];
    this.normals = [];
    this.colours = [];
    this.faces = [];
  }

  vertex(place, normal, colour) {
    this.places.push(...place);
    this.normals.push(...normal);
    this.colours.push(...colour);
    return this.places.length / 3 - 1;
  }

  // A round tube along points; colours is one for all, or one for each point.
  tube(points, radius, colours) {
    if (points.length < 2) return;
    let side = null, before = null;
    points.forEach((place, n) => {
      const forward = unit(minus(points[Math.min(n + 1, points.length - 1)], points[Math.max(n - 1, 0)]));
      const start = side || (Math.abs(forward[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]);
      side = unit(minus(start, times(forward, dot(start, forward))));
      const other = cross(forward, side);
      const colour = Array.isArray(colours[0]) ? colours[n] : colours;
      const ring = this.ring(place, side, other, radius, colour);
      if (before !== null) this.join(before, ring);
      if (n === 0) this.cap(ring, place, times(forward, -1), colour);
      if (n === points.length - 1) this.cap(ring, place, forward, colour);
      before = ring;
    });
  }

  ring(place, side, other, radius, colour) {
    const first = this.places.length / 3;
    for (let k = 0; k < this.sides; k++) {
      const angle = (2 * Math.PI * k) / this.sides;
      const normal = add(times(side, Math.cos(angle)), times(other, Math.sin(angle)));
      this.vertex(add(place, times(normal, radius)), normal, colour);
    }
    return first;
  }

  join(a, b) {
    for (let k = 0; k < this.sides; k++) {
      const next = (k + 1) % this.sides;
      this.faces.push(a + k, a + next, b + k, a + next, b + next, b + k);
    }
  }

  cap(ring, centre, normal, colour) {
    const middle = this.vertex(centre, normal, colour);
    for (let k = 0; k < this.sides; k++) this.faces.push(middle, ring + k, ring + ((k + 1) % this.sides));
  }

  ball(centre, radius, colour, rows = 10) {
    const first = this.places.length / 3;
    for (let i = 0; i <= rows; i++) {
      const polar = (Math.PI * i) / rows;
      for (let k = 0; k < this.sides; k++) {
        const angle = (2 * Math.PI * k) / this.sides;
        const normal = [Math.sin(polar) * Math.cos(angle), Math.sin(polar) * Math.sin(angle), Math.cos(polar)];
        this.vertex(add(centre, times(normal, radius)), normal, colour);
      }
    }
    for (let i = 0; i < rows; i++) this.join(first + i * this.sides, first + (i + 1) * this.sides);
  }
}

// Cut a line of points into bands of one colour and another, `lengths` of them in mm: points and a colour for each.
export function banded(points, colour, other, lengths) {
  if (!lengths || points.length < 2) return { points, colours: points.map(() => colour) };
  const found = { points: [], colours: [] };
  const put = (place, shade) => {
    found.points.push(place);
    found.colours.push(shade);
  };
  let band = 0, rest = lengths[0];
  const shade = () => (band % 2 ? other : colour);
  put(points[0], colour);
  for (let n = 0; n + 1 < points.length; n++) {
    const step = minus(points[n + 1], points[n]), length = norm(step);
    let at = 0;
    while (length - at > rest) {
      at += rest;
      put(add(points[n], times(step, at / length)), shade());
      band += 1;
      rest = lengths[band % 2];
      put(add(points[n], times(step, Math.min(at + 1e-3, length) / length)), shade());
    }
    rest -= length - at;
    put(points[n + 1], shade());
  }
  return found;
}
