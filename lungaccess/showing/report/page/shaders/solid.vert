#version 300 es
layout(location=0) in vec3 place;
layout(location=1) in vec3 normal;
layout(location=2) in vec3 shade;
uniform mat4 clipFromEye, eyeFromLps;
out vec3 eye, facing, colour;
void main() {
  vec4 there = eyeFromLps * vec4(place, 1.0);
  eye = there.xyz;
  facing = mat3(eyeFromLps) * normal;
  colour = shade;
  gl_Position = clipFromEye * there;
}
