// What the system reaches of the lung: voxels that take their colour as they become known.

// How strongly a voxel is coloured: known, and as it was before the system was changed.
const SHOWN = 0.62, PALE = 0.26;

export class ReachLayer {
  // before: the layer of the system before the change, whose voxels are pale until they are known anew.
  constructor(grid, colours, before = null) {
    this.grid = grid;
    this.shades = colours;
    this.kinds = new Uint8Array(grid.shape[0] * grid.shape[1] * grid.shape[2]);
    this.before = before && before.kinds.length === this.kinds.length ? before.latest() : null;
    this.share = 0;
    // What is only not reached by a single arc keeps the colours of its tissue.
    const shade = (share) => {
      const list = [];
      for (const [name, code] of Object.entries(grid.kinds)) {
        list[code] = name === "undecided" ? null : colours[name].map((value) => 255 * share * value);
      }
      return list;
    };
    this.colours = shade(SHOWN);
    this.pale = shade(PALE);
    this.reached = [grid.kinds["direct arc"], grid.kinds.search];
  }

  // Return the layer after a change of the system: all of it pale, until what is changed is known.
  outdated() {
    const made = new ReachLayer(this.grid, this.shades, this);
    made.isOutdated = true;
    return made;
  }

  // Return the kinds that were known last, voxel by voxel.
  latest() {
    return this.before ? this.kinds.map((kind, n) => kind || this.before[n]) : this.kinds;
  }

  take({ share, arrays: { voxels, kinds } }) {
    this.paint = null;
    for (let n = 0; n < voxels.length; n++) this.kinds[voxels[n]] = kinds[n];
    this.share = share;
    if (share >= 1) this.before = null;
  }

  // Return what paints the map over a slice: the same function as long as the map is the same.
  painter() {
    this.paint ??= this.made();
    return this.paint;
  }

  // Return the colour of a voxel, null for none.
  colour(n) {
    const kind = this.kinds[n];
    return kind ? this.colours[kind] : this.before && this.before[n] ? this.pale[this.before[n]] : null;
  }

  made() {
    const { grid: { shape: [ni, nj, nk], ijk_from_lps: m } } = this;
    return (x, y, z) => {
      const i = Math.round(m[0][0] * x + m[0][1] * y + m[0][2] * z + m[0][3]);
      const j = Math.round(m[1][0] * x + m[1][1] * y + m[1][2] * z + m[1][3]);
      const k = Math.round(m[2][0] * x + m[2][1] * y + m[2][2] * z + m[2][3]);
      if (i < 0 || j < 0 || k < 0 || i >= ni || j >= nj || k >= nk) return null;
      return this.colour((i * nj + j) * nk + k);
    };
  }

  // Return the points of the 3-D view, of all voxels that have a colour.
  points() {
    const { kinds, grid: { shape: [, nj, nk], lps_from_ijk: m, spacing_mm: spacing } } = this;
    const places = [], shades = [];
    kinds.forEach((_, n) => {
      const colour = this.colour(n);
      if (!colour) return;
      const i = Math.floor(n / (nj * nk)), j = Math.floor(n / nk) % nj, k = n % nk;
      for (let row = 0; row < 3; row++) places.push(m[row][0] * i + m[row][1] * j + m[row][2] * k + m[row][3]);
      shades.push(...colour.map((value) => value / 255));
    });
    return { places, colours: shades, radii: 0.16 * spacing };
  }

  // Say in words how much is reached of what is known; by: "a single arc" or "the tubes".
  words(by) {
    if (this.isOutdated) return `Pale: what ${this.grid.system} reaches. What the changed system reaches is not known yet.`;
    let reached = 0, known = 0;
    for (const kind of this.kinds) {
      known += kind ? 1 : 0;
      reached += this.reached.includes(kind) ? 1 : 0;
    }
    const ml = (count) => `${Math.round(count * this.grid.voxel_ml)} mL`;
    const pale = this.before ? ", the pale rest is that of the system before" : "";
    const whole = this.share >= 1 ? "" : `; ${Math.round(100 * this.share)} % of the lung known so far${pale}`;
    return known ? `Reached by ${by}: ${ml(reached)} of ${ml(known)} (${((100 * reached) / known).toFixed(0)} %)${whole}` : "";
  }
}
