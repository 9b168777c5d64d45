// Voxels and where they are: grids of any direction and spacing, values between voxels, and the CT that a page holds.
import { unpackVolume } from "./decode.js";
import { cross, dot, norm, times } from "./vectors.js";

// A grid of voxels; whole indices are their centres, as in anatomy.grid.
export class VoxelGrid {
  // shape: [ni, nj, nk]; rows: the first three rows of lps_from_ijk.
  constructor(shape, rows) {
    const [a, b, c] = [0, 1, 2].map((column) => [0, 1, 2].map((row) => rows[row][column]));
    const size = dot(a, cross(b, c));
    this.shape = shape;
    this.first = [0, 1, 2].map((row) => rows[row][3]);
    this.steps = [a, b, c];
    this.spacing = [a, b, c].map(norm);
    // Rows of ijk_from_lps without their shift.
    this.inverse = [cross(b, c), cross(c, a), cross(a, b)].map((row) => times(row, 1 / size));
    this.shift = this.inverse.map((row) => -dot(row, this.first));
  }

  // Return the place of indices, LPS mm.
  lps(ijk) {
    return this.first.map((first, axis) => first + this.steps.reduce((sum, step, n) => sum + ijk[n] * step[axis], 0));
  }

  // Return the indices of a place with their fractions.
  ijk(place) {
    return this.inverse.map((row, n) => dot(row, place) + this.shift[n]);
  }

  // Return the indices of the voxel that holds a place; null beyond the grid.
  voxel(place) {
    const found = this.ijk(place).map((index) => Math.floor(index + 0.5));
    return found.every((index, axis) => index >= 0 && index < this.shape[axis]) ? found : null;
  }

  // Return how far the next layer of voxels is in a direction, mm.
  stepAlong(direction) {
    return norm(direction) / Math.max(...this.inverse.map((row) => Math.abs(dot(row, direction))));
  }
}

// Return a volume of the page: its voxels, i fastest, on a grid; a table says what stored bytes stand for.
export async function placedVolume(packed, table = null) {
  const volume = await unpackVolume(packed);
  const { width, height, depth, first, spacing } = volume;
  const rows = [0, 1, 2].map((row) => [0, 1, 2].map((column) => (row === column ? spacing : 0)).concat(first[row]));
  const voxels = table ? Int16Array.from(volume.voxels, (byte) => table[byte]) : volume.voxels;
  return volumeOf(new VoxelGrid([width, height, depth], rows), voxels);
}

// Return a volume of voxels, i fastest, on a grid.
export function volumeOf(grid, voxels) {
  const [width, height, depth] = grid.shape;
  const m = Float64Array.from(grid.inverse.flatMap((row, n) => [...row, grid.shift[n]]));
  return { grid, voxels, width, height, depth, m, first: grid.first, spacing: grid.spacing[0] };
}

// Return the value of the voxel that holds a point, of the last volume that does; 0 beyond all.
export function nearest(volumes, x, y, z) {
  for (let n = volumes.length - 1; n >= 0; n--) {
    const { m, width, height, depth, voxels } = volumes[n];
    const i = Math.floor(m[0] * x + m[1] * y + m[2] * z + m[3] + 0.5);
    const j = Math.floor(m[4] * x + m[5] * y + m[6] * z + m[7] + 0.5);
    const k = Math.floor(m[8] * x + m[9] * y + m[10] * z + m[11] + 0.5);
    if (i >= 0 && j >= 0 && k >= 0 && i < width && j < height && k < depth) return voxels[(k * height + j) * width + i];
  }
  return 0;
}

// Return the value between the eight voxels around a point, of the last volume that has them; NaN beyond all.
export function linear(volumes, x, y, z) {
  for (let n = volumes.length - 1; n >= 0; n--) {
    const { m, width, height, depth, voxels: a } = volumes[n];
    const fx = m[0] * x + m[1] * y + m[2] * z + m[3], fy = m[4] * x + m[5] * y + m[6] * z + m[7];
    const fz = m[8] * x + m[9] * y + m[10] * z + m[11];
    const i = Math.floor(fx), j = Math.floor(fy), k = Math.floor(fz);
    if (i < 0 || j < 0 || k < 0 || i + 1 >= width || j + 1 >= height || k + 1 >= depth) continue;
    const u = fx - i, t = fy - j, s = fz - k, slice = width * height;
    const at = (k * height + j) * width + i, row = at + width, up = at + slice, far = row + slice;
    const lower = (1 - t) * ((1 - u) * a[at] + u * a[at + 1]) + t * ((1 - u) * a[row] + u * a[row + 1]);
    const upper = (1 - t) * ((1 - u) * a[up] + u * a[up + 1]) + t * ((1 - u) * a[far] + u * a[far + 1]);
    return (1 - s) * lower + s * upper;
  }
  return NaN;
}

// A source of a CT has
//   grid: VoxelGrid of its voxels;
//   slice(raster): a promise of the values in HU at the pixels of a plane, row by row (NaN or less than any HU beyond the
//   CT), or of null if it has none; raster: { origin, across, down, columns, rows }, the place of the first pixel's centre
//   and the steps to the next column and row, LPS mm.
// This one has the volumes of the page, of which the last that holds a place counts.
export class PackedSource {
  constructor(volumes) {
    this.volumes = volumes;
    this.grid = volumes[volumes.length - 1].grid;
  }

  value([x, y, z]) {
    return linear(this.volumes, x, y, z);
  }

  async slice({ origin, across, down, columns, rows }) {
    const values = new Float32Array(columns * rows);
    for (let row = 0, n = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++, n++) {
        values[n] = linear(
          this.volumes, origin[0] + column * across[0] + row * down[0], origin[1] + column * across[1] + row * down[1],
          origin[2] + column * across[2] + row * down[2]);
      }
    }
    return values;
  }
}
