// What the system reaches of the lung: voxels that take their colour as they become known.
import { rgb } from "../report/vectors.js";
import { nearest, volumeOf, VoxelGrid } from "../report/voxels.js";

// How densely a voxel is painted over the picture: known, and as it was before the system was changed, which has codes of its own.
const SHOWN = 0.25, PALE = 0.1, BEFORE = 128;

export class ReachLayer {
  // before: the layer of the system before the change, whose voxels are pale until they are known anew.
  constructor(grid, before = null) {
    const { shape: [ni, nj, nk], lps_from_ijk: rows, colours } = grid;
    Object.assign(this, { grid, share: 0, said: "", colours: [] });
    // The last index is the fastest, as in the arrays of the answers.
    this.volume = volumeOf(new VoxelGrid([nk, nj, ni], rows.map(([i, j, k, first]) => [k, j, i, first])), new Uint8Array(ni * nj * nk));
    if (before && before.kinds.length === this.kinds.length) this.kinds.set(before.kinds.map((kind) => kind && kind | BEFORE));
    // What is only not reached by a single arc keeps the colours of its tissue.
    for (const [code, colour] of Object.entries(colours)) {
      const bytes = rgb(colour).map((value) => 255 * value);
      this.colours[code] = [...bytes, SHOWN];
      this.colours[code | BEFORE] = [...bytes, PALE];
    }
  }

  get kinds() {
    return this.volume.voxels;
  }

  // Return the layer after a change of the system: all of it pale, until what is changed is known.
  outdated() {
    const layer = new ReachLayer(this.grid, this);
    layer.isOutdated = true;
    return layer;
  }

  take({ share, words, arrays: { voxels, kinds } }) {
    Object.assign(this, { share, said: words, paint: null });
    voxels.forEach((voxel, n) => {
      this.kinds[voxel] = kinds[n];
    });
    return this;
  }

  // Return what paints the map over a slice: the same function as long as the map is the same.
  painter() {
    const volumes = [this.volume];
    this.paint ??= (x, y, z) => this.colours[nearest(volumes, x, y, z)];
    return this.paint;
  }

  // Return the points of the 3-D view, of all voxels that have a colour.
  points() {
    const { kinds, colours, grid: { shape: [, nj, nk], spacing_mm: spacing } } = this;
    const places = [], shades = [];
    kinds.forEach((kind, n) => {
      if (!colours[kind]) return;
      places.push(...this.volume.grid.lps([n % nk, Math.floor(n / nk) % nj, Math.floor(n / (nj * nk))]));
      shades.push(...colours[kind].slice(0, 3).map((value) => (value / 255) * (kind & BEFORE ? 0.5 : 1)));
    });
    return { places, colours: shades, radii: 0.16 * spacing };
  }

  // Say in words how much is reached of what is known.
  words() {
    if (this.isOutdated) return `Pale: what ${this.grid.system} reaches. What the changed system reaches is not known yet.`;
    return `${this.said}${this.kinds.some((kind) => kind > BEFORE) ? ", the pale rest is that of the system before" : ""}`;
  }
}
