#version 300 es
// This writes the colour, and beside it which body it is and how deep.
precision highp float;
in vec3 eye, facing, colour;
uniform float number, lamp;
layout(location=0) out vec4 result;
layout(location=1) out vec4 known;
#include "stored_depth.glsl"
void main() {
  float straight = abs(dot(normalize(facing), normalize(eye)));
  vec3 lit = colour * (0.35 + 0.65 * straight) + vec3(0.25) * pow(straight, 24.0);
  lit /= 1.0 + lamp * dot(eye, eye);
  result = vec4(lit, 1.0);
  known = vec4(number, twoBytes(depthOf(eye.z)), 0.0);
}
