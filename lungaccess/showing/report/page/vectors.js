// Vectors of three numbers and 4x4 matrices, columns first.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const norm = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => times(a, 1 / Math.max(norm(a), 1e-9));
export const mix = (a, b, s) => [a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]), a[2] + s * (b[2] - a[2])];
export const point = (array, n) => [array[3 * n], array[3 * n + 1], array[3 * n + 2]];

// Right-handed, so that no side is exchanged: the camera looks along forward.
export function eyeFromLps(eye, forward, up) {
  const right = unit(cross(forward, up));
  const above = cross(right, forward);
  const back = times(forward, -1);
  return new Float32Array([
    right[0], above[0], back[0], 0, right[1], above[1], back[1], 0, right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ]);
}

export function perspective(halfAngle, aspect, near, far) {
  const f = 1 / Math.tan(halfAngle);
  const fx = aspect >= 1 ? f / aspect : f;
  const fy = aspect >= 1 ? f : f * aspect;
  return new Float32Array([
    fx, 0, 0, 0, 0, fy, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0,
  ]);
}

const AXES = [["R", "L"], ["A", "P"], ["F", "H"]];

// Name an LPS direction by its main letters, the strongest first: R L, A P, and H F for head and feet.
export function letters(direction) {
  return [0, 1, 2]
    .filter((axis) => Math.abs(direction[axis]) > 0.35)
    .sort((a, b) => Math.abs(direction[b]) - Math.abs(direction[a]))
    .map((axis) => AXES[axis][direction[axis] > 0 ? 1 : 0])
    .join("");
}

// Return the colour at a share, 0 to 1, of a ramp of colours "#rrggbb".
export function ramp(colours, share) {
  const at = Math.min(Math.max(share, 0), 1) * (colours.length - 1), n = Math.min(Math.floor(at), colours.length - 2);
  return mix(rgb(colours[n]), rgb(colours[n + 1]), at - n);
}

// Return red, green and blue of "#rrggbb", 0 to 1.
export const rgb = (hex) => [1, 3, 5].map((n) => parseInt(hex.slice(n, n + 2), 16) / 255);
