// The CT as the server has it: the source of sharp slices; voxels.js says what a source is.

export class CtSource {
  constructor(connection) {
    this.connection = connection;
    this.asked = 0;
  }

  async slice(raster) {
    let values = null;
    this.asked += 1;
    // A slot of its own: each slice asks one at a time, and none takes the place of another.
    await this.connection.ask("slice", { ...raster, slot: `${this.asked}` }, ({ arrays: { hu } }) => {
      values = hu;
    }).done;
    return values;
  }
}
