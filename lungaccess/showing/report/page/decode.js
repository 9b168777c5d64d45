// Arrays and volumes as lungaccess.showing.report.html.pack stores them.

export const TYPES = { u1: Uint8Array, u2: Uint16Array, i4: Int32Array, f4: Float32Array };

// Read the data of the page.
export function reportData() {
  return JSON.parse(document.getElementById("report-data").textContent);
}

function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

// Return the flat typed array of a packed one.
export async function unpack(packed) {
  const stream = new Blob([bytesOf(packed.data)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const Kind = TYPES[packed.kind], width = Kind.BYTES_PER_ELEMENT;
  if (width === 1) return planes;
  const count = planes.length / width, joined = new Uint8Array(planes.length);
  for (let b = 0; b < width; b++) {
    for (let n = 0, from = b * count, to = b; n < count; n++, from++, to += width) joined[to] = planes[from];
  }
  return new Kind(joined.buffer);
}

// Return an object of packed arrays with the arrays.
export async function unpackAll(packed) {
  return Object.fromEntries(await Promise.all(Object.entries(packed).map(async ([key, each]) => [key, await unpack(each)])));
}

// Return a volume with its voxels, i fastest.
export async function unpackVolume(packed) {
  const voxels = await unpack(packed.voxels);
  const [depth, height, width] = packed.voxels.shape;
  if (packed.differences) {
    for (let row = 0; row < voxels.length; row += width) {
      for (let i = 1; i < width; i++) voxels[row + i] += voxels[row + i - 1];
    }
  }
  return { voxels, width, height, depth, first: packed.first_lps, spacing: packed.spacing_mm };
}
