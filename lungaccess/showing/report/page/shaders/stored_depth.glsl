// A texel of a layer holds red how near the focus it is, green and blue the depth, and in alpha how straight it is seen:
// from the outside 1/2 to 1, from the inside 1/2 to 0.  All is in floats: whole numbers are slow where the processor draws.
uniform vec2 span;
const float NOTHING = 65535.0;
float depthOf(float z) { return floor(clamp((-z - span.x) / (span.y - span.x), 0.0, 1.0) * 65534.0 + 0.5); }
vec2 twoBytes(float depth) { float high = floor(depth / 256.0); return vec2(high, depth - 256.0 * high) / 255.0; }
float stored(vec4 texel) { return floor(texel.g * 65280.0 + texel.b * 255.0 + 0.5); }
