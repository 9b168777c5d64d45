// The pictures that are put together: the solid bodies, and for each structure its nearest layers.
const NOTHING = [0, 1, 1, 0];

// Framebuffers of one size: `solids` holds colour and depth, `peeled[k][n]` the layer k of the structure n.
export class Layers {
  constructor(gl) {
    this.gl = gl;
    this.width = this.height = this.slices = 0;
    this.textures = [];
  }

  // Make room for so many structures; returns whether it is new and empty.
  fit(width, height, slices) {
    if (width === this.width && height === this.height && slices <= this.slices) return false;
    const gl = this.gl;
    this.free();
    Object.assign(this, { width, height, slices: Math.max(slices, 1) });
    this.depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    this.colour = this.texture(gl.TEXTURE_2D);
    this.known = this.texture(gl.TEXTURE_2D);
    this.solids = this.framebuffer([this.colour, this.known]);
    // A framebuffer for the second picture of the solid bodies alone, to read from.
    this.reading = this.framebuffer([this.known]);
    this.arrays = [0, 1].map(() => this.texture(gl.TEXTURE_2D_ARRAY));
    this.peeled = this.arrays.map((array) => Array.from({ length: this.slices }, (_, n) => this.framebuffer([array], n)));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return true;
  }

  texture(kind) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(kind, texture);
    if (kind === gl.TEXTURE_2D) gl.texStorage2D(kind, 1, gl.RGBA8, this.width, this.height);
    else gl.texStorage3D(kind, 1, gl.RGBA8, this.width, this.height, this.slices);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(kind, name, gl.NEAREST);
    this.textures.push(texture);
    return texture;
  }

  // Return a framebuffer of pictures, or of a slice of an array of them.
  framebuffer(textures, slice = null) {
    const { gl } = this, framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const places = textures.map((_, n) => gl.COLOR_ATTACHMENT0 + n);
    textures.forEach((texture, n) => {
      if (slice === null) gl.framebufferTexture2D(gl.FRAMEBUFFER, places[n], gl.TEXTURE_2D, texture, 0);
      else gl.framebufferTextureLayer(gl.FRAMEBUFFER, places[n], texture, 0, slice);
    });
    gl.drawBuffers(places);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.depth);
    return framebuffer;
  }

  free() {
    const gl = this.gl;
    for (const texture of this.textures) gl.deleteTexture(texture);
    this.textures = [];
    if (!this.solids) return;
    for (const each of [this.solids, this.reading, ...this.peeled.flat()]) gl.deleteFramebuffer(each);
    gl.deleteRenderbuffer(this.depth);
  }

  // Draw from now on into a framebuffer, which is emptied.
  into(framebuffer) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.viewport(0, 0, this.width, this.height);
    const buffers = framebuffer === this.solids ? 2 : 1;
    for (let n = 0; n < buffers; n++) gl.clearBufferfv(gl.COLOR, n, NOTHING);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
  }

  // Wait until all is drawn, and return pixels of the framebuffer that is bound, four bytes each.  They come through a
  // buffer: of pixels that are read directly, drivers write to the console that one has to wait for them.
  pixels(x, y, width, height) {
    const gl = this.gl, bytes = new Uint8Array(4 * width * height);
    this.buffer ??= gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, this.buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, bytes.length, gl.STREAM_READ);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, bytes);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    return bytes;
  }

  // Return what is stored at a place of a framebuffer, in pixels from its lower left: the number of a body, and the depth
  // as it is stored, 65535 for nothing; between the four pixels around where these differ by no more than `most`.
  read(framebuffer, x, y, most) {
    const gl = this.gl;
    const column = Math.min(Math.max(Math.floor(x - 0.5), 0), Math.max(this.width - 2, 0));
    const row = Math.min(Math.max(Math.floor(y - 0.5), 0), Math.max(this.height - 2, 0));
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    const bytes = this.pixels(column, row, 2, 2);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const deep = [0, 1, 2, 3].map((n) => 256 * bytes[4 * n + 1] + bytes[4 * n + 2]);
    const nearest = (Math.floor(x) > column ? 1 : 0) + (Math.floor(y) > row ? 2 : 0);
    const [u, v] = [Math.min(Math.max(x - 0.5 - column, 0), 1), Math.min(Math.max(y - 0.5 - row, 0), 1)];
    const low = deep[0] + u * (deep[1] - deep[0]), high = deep[2] + u * (deep[3] - deep[2]);
    const isOne = Math.max(...deep) - Math.min(...deep) <= most && Math.max(...deep) < 65535;
    return { number: bytes[4 * nearest], depth: isOne ? low + v * (high - low) : deep[nearest] };
  }
}
