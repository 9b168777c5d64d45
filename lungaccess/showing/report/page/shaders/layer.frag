#version 300 es
// This draws one layer of a structure: what is nearest behind the layer before.
precision highp float;
precision highp int;
precision highp sampler2DArray;
in vec3 eye, facing;
in float near, kept;
uniform int slice, peeled;
uniform sampler2DArray before;
out vec4 result;
#include "stored_depth.glsl"
void main() {
  if (kept < 0.0) discard;
  float depth = depthOf(eye.z);
  if (peeled != 0 && depth <= stored(texelFetch(before, ivec3(gl_FragCoord.xy, slice), 0))) discard;
  result = vec4(near, twoBytes(depth), 0.5 - 0.5 * dot(normalize(facing), normalize(eye)));
}
