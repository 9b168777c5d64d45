// What the system reaches of the lung: voxels that take their colour as they become known.

const SHOWN = 0.62;

export class ReachLayer {
  constructor(grid, colours) {
    this.grid = grid;
    this.kinds = new Uint8Array(grid.shape[0] * grid.shape[1] * grid.shape[2]);
    this.share = 0;
    this.colours = [];
    // What is only not reached by a single arc keeps the colours of its tissue.
    for (const [name, code] of Object.entries(grid.kinds)) {
      this.colours[code] = name === "undecided" ? null : colours[name].map((value) => 255 * SHOWN * value);
    }
    this.reached = [grid.kinds["direct arc"], grid.kinds.search];
  }

  take({ share, arrays: { voxels, kinds } }) {
    this.paint = null;
    for (let n = 0; n < voxels.length; n++) this.kinds[voxels[n]] = kinds[n];
    this.share = share;
  }

  // Return what paints the map over a slice: the same function as long as the map is the same.
  painter() {
    this.paint ??= this.made();
    return this.paint;
  }

  made() {
    const { kinds, colours, grid: { shape: [ni, nj, nk], ijk_from_lps: m } } = this;
    return (x, y, z) => {
      const i = Math.round(m[0][0] * x + m[0][1] * y + m[0][2] * z + m[0][3]);
      const j = Math.round(m[1][0] * x + m[1][1] * y + m[1][2] * z + m[1][3]);
      const k = Math.round(m[2][0] * x + m[2][1] * y + m[2][2] * z + m[2][3]);
      if (i < 0 || j < 0 || k < 0 || i >= ni || j >= nj || k >= nk) return null;
      const kind = kinds[(i * nj + j) * nk + k];
      return kind ? colours[kind] : null;
    };
  }

  // Return the points of the 3-D view, of all voxels that have a colour.
  points() {
    const { kinds, colours, grid: { shape: [, nj, nk], lps_from_ijk: m, spacing_mm: spacing } } = this;
    const places = [], shades = [];
    kinds.forEach((kind, n) => {
      if (!kind || !colours[kind]) return;
      const i = Math.floor(n / (nj * nk)), j = Math.floor(n / nk) % nj, k = n % nk;
      for (let row = 0; row < 3; row++) places.push(m[row][0] * i + m[row][1] * j + m[row][2] * k + m[row][3]);
      shades.push(...colours[kind].map((value) => value / 255));
    });
    return { places, colours: shades, radii: 0.16 * spacing };
  }

  // Say in words how much is reached of what is known.
  words() {
    let reached = 0, known = 0;
    for (const kind of this.kinds) {
      known += kind ? 1 : 0;
      reached += this.reached.includes(kind) ? 1 : 0;
    }
    const ml = (count) => `${Math.round(count * this.grid.voxel_ml)} mL`;
    const whole = this.share >= 1 ? "" : `; ${Math.round(100 * this.share)} % of the lung known so far`;
    return known ? `Reached by a single arc: ${ml(reached)} of ${ml(known)} (${((100 * reached) / known).toFixed(0)} %)${whole}` : "";
  }
}
