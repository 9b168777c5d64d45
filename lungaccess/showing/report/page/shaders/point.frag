#version 300 es
// A point is a disc that is shaded as a ball.  Alpha says that it has no outline: many small ones would be all outline.
precision highp float;
in vec3 centre, colour;
in float ball;
uniform float number;
layout(location=0) out vec4 result;
layout(location=1) out vec4 known;
#include "stored_depth.glsl"
void main() {
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  float rest = 1.0 - dot(at, at);
  if (rest < 0.0) discard;
  float straight = sqrt(rest);
  result = vec4(colour * (0.45 + 0.55 * straight), 1.0);
  known = vec4(number, twoBytes(depthOf(centre.z + straight * ball)), 1.0);
}
