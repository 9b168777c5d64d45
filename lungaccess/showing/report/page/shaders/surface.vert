#version 300 es
layout(location=0) in vec3 place;
layout(location=1) in vec3 normal;
layout(location=2) in vec3 displacement;
layout(location=3) in float focus;
uniform mat4 clipFromEye, eyeFromLps;
uniform vec3 low, size;
uniform float share;
uniform vec4 cut;
out vec3 eye, facing;
out float near, kept;
void main() {
  vec3 lps = low + place * size + share * displacement;
  vec4 there = eyeFromLps * vec4(lps, 1.0);
  eye = there.xyz;
  facing = mat3(eyeFromLps) * normal;
  near = focus;
  kept = dot(cut.xyz, lps) + cut.w;
  gl_Position = clipFromEye * there;
}
