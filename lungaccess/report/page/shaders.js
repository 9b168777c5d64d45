// The programs of the graphics card.

const SURFACE_VERTEX = `#version 300 es
layout(location=0) in vec3 place;
layout(location=1) in vec3 normal;
layout(location=2) in vec3 displacement;
uniform mat4 clipFromEye, eyeFromLps;
uniform vec3 low, size;
uniform float share;
out vec3 eye, facing;
void main() {
  vec4 there = eyeFromLps * vec4(low + place * size + share * displacement, 1.0);
  eye = there.xyz;
  facing = mat3(eyeFromLps) * normal;
  gl_Position = clipFromEye * there;
}`;

// See-through: denser where the surface is seen from the side.
const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 eye, facing;
uniform vec3 colour;
uniform float opacity, rim;
out vec4 result;
void main() {
  float straight = abs(dot(normalize(facing), normalize(eye)));
  float alpha = clamp(opacity + rim * pow(1.0 - straight, 2.0), 0.0, 1.0);
  vec3 lit = colour * (0.45 + 0.6 * straight);
  result = vec4(lit * alpha, alpha);
}`;

// The inside of the airway by the light at the tip of the scope.
const INSIDE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 eye, facing;
out vec4 result;
void main() {
  float away = length(eye);
  float straight = abs(dot(normalize(facing), eye / away));
  float light = (0.25 + 0.85 * straight) / (1.0 + away * away / 520.0);
  vec3 wall = mix(vec3(0.50, 0.16, 0.13), vec3(0.98, 0.72, 0.64), clamp(light * 1.15, 0.0, 1.0));
  result = vec4(wall * clamp(light * 1.5, 0.0, 1.0), 1.0);
}`;

const SOLID_VERTEX = `#version 300 es
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
}`;

const SOLID_FRAGMENT = `#version 300 es
precision highp float;
in vec3 eye, facing, colour;
out vec4 result;
void main() {
  float straight = abs(dot(normalize(facing), normalize(eye)));
  vec3 lit = colour * (0.35 + 0.65 * straight) + vec3(0.25) * pow(straight, 24.0);
  result = vec4(lit, 1.0);
}`;

function compiled(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const places = {};
  for (const name of ["clipFromEye", "eyeFromLps", "low", "size", "colour", "opacity", "rim", "share"]) {
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

// Return the three programs: surface, inside and solid.
export function programs(gl) {
  return {
    surface: linked(gl, SURFACE_VERTEX, SURFACE_FRAGMENT),
    inside: linked(gl, SURFACE_VERTEX, INSIDE_FRAGMENT),
    solid: linked(gl, SOLID_VERTEX, SOLID_FRAGMENT),
  };
}
