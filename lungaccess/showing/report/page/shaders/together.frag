#version 300 es
// All layers of a pixel are put together, with an outline around solid bodies, and haze with the distance.  Nothing is
// sorted: of each layer as much is seen as those before it let through, which is the same and takes no lists, which are
// slow where the processor draws.
precision highp float;
precision highp sampler2DArray;
#define LAYER(from, n, colour, depth, later) texel = texelFetch(from, ivec3(at, n), 0); float depth = stored(texel); \
  vec4 colour = look(looks[n], texel, depth, deepest); depth += later;
#define THROUGH(colour, depth, reached) (depth < reached ? 1.0 - colour.a : 1.0)
#ifndef LAYERS
// These are the definitions for one layer of one structure; the page puts those for its layers before them.
#define MOST_SLICES 16
#define LAYERS LAYER(first, 0, c0, d0, 0.0)
#define THROUGH_LAYERS(reached) * THROUGH(c0, d0, reached)
#define SUM_OF_LAYERS + c0.rgb * (c0.a * THROUGH_ALL(d0))
#endif
#define THROUGH_ALL(reached) THROUGH(rim, rim_depth, reached) THROUGH_LAYERS(reached)
uniform sampler2DArray first, second;
uniform sampler2D solids, known;
uniform vec4 looks[MOST_SLICES];
uniform vec3 background, ink, haze, dense;
uniform float outline, step_mm;
out vec4 result;
const float BEYOND_ALL = 1e6;
#include "stored_depth.glsl"
// Colour and density of a place: it is denser where it is seen from the side, and near the focus; paler far away.
vec4 look(vec4 colour, vec4 texel, float depth, float deepest) {
  float side = 2.0 * texel.a - 1.0, straight = abs(side), aside = 1.0 - straight;
  float alpha = min(colour.a * (dense.x + dense.y * texel.r), 1.0);
  alpha = depth < deepest ? min(alpha + dense.z * min(1.0, 2.0 * alpha) * aside * aside, 1.0) : 0.0;
  vec3 lit = colour.rgb * (side < 0.0 ? 0.32 + 0.42 * straight : 0.45 + 0.6 * straight);
  return vec4(lit + (background - lit) * clamp(depth * haze.x + haze.y, 0.0, haze.z), alpha);
}
float outlined(ivec2 at) {
  vec4 texel = texelFetch(known, at, 0);
  return stored(texel) + texel.a * NOTHING;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float deepest = stored(texelFetch(known, at, 0));
  vec3 behind = deepest < NOTHING ? texelFetch(solids, at, 0).rgb : background;
  vec4 rim = vec4(ink, 0.0), texel;
  ivec2 end = textureSize(known, 0) - 1, low = max(at - int(outline), 0), high = min(at + int(outline), end);
  float rim_depth = min(min(outlined(ivec2(high.x, at.y)), outlined(ivec2(low.x, at.y))),
    min(outlined(ivec2(at.x, high.y)), outlined(ivec2(at.x, low.y)))) - 0.5;
  float edge = (deepest - rim_depth) * step_mm > 0.8 ? 0.75 : 0.0;
  if (deepest < NOTHING) behind = mix(behind, ink, edge);
  else rim.a = edge;
  LAYERS
  vec3 sum = rim.rgb * (rim.a * THROUGH_ALL(rim_depth)) SUM_OF_LAYERS;
  result = vec4(sum + behind * THROUGH_ALL(BEYOND_ALL), 1.0);
}
