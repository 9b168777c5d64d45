#version 300 es
// This draws the inside of the airway by the light at the tip of the scope.
precision highp float;
in vec3 eye, facing;
out vec4 result;
void main() {
  float away = length(eye);
  float straight = abs(dot(normalize(facing), eye / away));
  float light = (0.25 + 0.85 * straight) / (1.0 + away * away / 520.0);
  vec3 wall = mix(vec3(0.50, 0.16, 0.13), vec3(0.98, 0.72, 0.64), clamp(light * 1.15, 0.0, 1.0));
  result = vec4(wall * clamp(light * 1.5, 0.0, 1.0), 1.0);
}
