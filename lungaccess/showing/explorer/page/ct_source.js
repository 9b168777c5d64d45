// The CT as the server has it: the source of sharp slices; voxels.js says what a source is.

export function ctSource(connection) {
  let asked = 0;
  return {
    async slice(raster) {
      let values = null;
      // A slot of its own: each slice asks one at a time, and none takes the place of another.
      await connection.ask("slice", { ...raster, slot: `${++asked}` }, ({ arrays: { hu } }) => {
        values = hu;
      }).done;
      return values;
    },
  };
}
