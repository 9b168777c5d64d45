#version 300 es
layout(location=0) in vec3 place;
layout(location=1) in float radius;
layout(location=2) in vec3 shade;
uniform mat4 clipFromEye, eyeFromLps;
uniform vec2 pixels;
out vec3 centre, colour;
out float ball;
void main() {
  vec4 there = eyeFromLps * vec4(place, 1.0);
  centre = there.xyz;
  colour = shade;
  gl_Position = clipFromEye * there;
  float shown = max(pixels.x * radius / gl_Position.w, pixels.y);
  ball = shown * gl_Position.w / pixels.x;
  gl_PointSize = 2.0 * shown;
}
