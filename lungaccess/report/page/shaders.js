// The programs of the graphics card.

// A texel of a layer: red how near the focus, green and blue the depth, alpha how straight and from which side it is seen.
const STORED_DEPTH = `
uniform vec2 span;
uint depthOf(float z) { return uint(clamp((-z - span.x) / (span.y - span.x), 0.0, 1.0) * 65534.0 + 0.5); }
vec2 twoBytes(uint depth) { return vec2(float(depth >> 8), float(depth & 255u)) / 255.0; }
uint stored(vec4 texel) { return (uint(texel.g * 255.0 + 0.5) << 8) | uint(texel.b * 255.0 + 0.5); }`;

const SURFACE_VERTEX = `#version 300 es
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
}`;

// One layer of a structure: what is nearest behind the layer before.
const LAYER_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
in vec3 eye, facing;
in float near, kept;
uniform float outward;
uniform int slice, peeled;
uniform sampler2DArray before;
out vec4 result;
${STORED_DEPTH}
void main() {
  if (kept < 0.0) discard;
  uint depth = depthOf(eye.z);
  if (peeled != 0 && depth <= stored(texelFetch(before, ivec3(gl_FragCoord.xy, slice), 0))) discard;
  float straight = dot(normalize(facing), normalize(eye)) * outward;
  result = vec4(near, twoBytes(depth), (floor(abs(straight) * 127.0 + 0.5) + (straight > 0.0 ? 128.0 : 0.0)) / 255.0);
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

// Colour, and beside it which body it is and how deep.
const SOLID_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
in vec3 eye, facing, colour;
uniform float number;
layout(location=0) out vec4 result;
layout(location=1) out vec4 known;
${STORED_DEPTH}
void main() {
  float straight = abs(dot(normalize(facing), normalize(eye)));
  vec3 lit = colour * (0.35 + 0.65 * straight) + vec3(0.25) * pow(straight, 24.0);
  result = vec4(lit, 1.0);
  known = vec4(number, twoBytes(depthOf(eye.z)), 0.0);
}`;

// A point is a disc that is shaded as a ball.
const POINT_VERTEX = `#version 300 es
layout(location=0) in vec3 place;
layout(location=1) in vec3 shade;
layout(location=2) in float radius;
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
}`;

const POINT_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
in vec3 centre, colour;
in float ball;
uniform float number;
layout(location=0) out vec4 result;
layout(location=1) out vec4 known;
${STORED_DEPTH}
void main() {
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  float rest = 1.0 - dot(at, at);
  if (rest < 0.0) discard;
  float straight = sqrt(rest);
  result = vec4(colour * (0.45 + 0.55 * straight), 1.0);
  known = vec4(number, twoBytes(depthOf(centre.z + straight * ball)), 0.0);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

export const MOST_SLICES = 16;

// All layers of a pixel in the order of their depth, an outline around solid bodies, and haze with the distance.
const TOGETHER_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2DArray;
uniform sampler2DArray first, second;
uniform sampler2D solids, known;
uniform int slices, layers;
uniform vec4 looks[${MOST_SLICES}];
uniform vec2 strength;
uniform vec3 background, ink;
uniform float outline, step_mm, focused;
uniform vec3 haze;
out vec4 result;
${STORED_DEPTH}
const int MOST = ${2 * MOST_SLICES + 1};
uint keys[MOST];
uint values[MOST];
int count = 0;
void put(uint depth, uint value) {
  int n = count;
  while (n > 0 && keys[n - 1] > depth) { keys[n] = keys[n - 1]; values[n] = values[n - 1]; n -= 1; }
  keys[n] = depth;
  values[n] = value;
  count += 1;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 solid = texelFetch(solids, at, 0);
  uint deepest = stored(texelFetch(known, at, 0));
  float darker = 0.0;
  if (outline > 0.0) {
    ivec2 last = textureSize(known, 0) - 1;
    int r = int(outline);
    uint nearest = 65535u;
    for (int k = 0; k < 4; k++) {
      ivec2 aside = k == 0 ? ivec2(r, 0) : k == 1 ? ivec2(-r, 0) : k == 2 ? ivec2(0, r) : ivec2(0, -r);
      nearest = min(nearest, stored(texelFetch(known, clamp(at + aside, ivec2(0), last), 0)));
    }
    float gap = (float(deepest) - float(nearest)) * step_mm;
    if (nearest < 65535u && gap > 0.8) {
      if (deepest < 65535u) darker = 0.75;
      else put(nearest, 0xffffffffu);
    }
  }
  for (int n = 0; n < slices; n++) {
    vec4 texel = texelFetch(first, ivec3(at, n), 0);
    uint depth = stored(texel);
    if (depth >= deepest) continue;
    put(depth, (uint(n) << 16) | (uint(texel.r * 255.0 + 0.5) << 8) | uint(texel.a * 255.0 + 0.5));
    if (layers < 2) continue;
    texel = texelFetch(second, ivec3(at, n), 0);
    depth = stored(texel);
    if (depth < deepest) put(depth, (uint(n) << 16) | (uint(texel.r * 255.0 + 0.5) << 8) | uint(texel.a * 255.0 + 0.5));
  }
  vec3 sum = vec3(0.0);
  float left = 1.0;
  for (int n = 0; n < count && left > 0.004; n++) {
    uint value = values[n];
    if (value == 0xffffffffu) {
      sum += left * 0.75 * ink;
      left *= 0.25;
      continue;
    }
    vec4 look = looks[value >> 16];
    float straight = float(value & 127u) / 127.0;
    float near = float((value >> 8) & 255u) / 255.0;
    float dense = min(strength.x * look.a * mix(1.0, mix(0.55, 1.5, near), focused), 1.0);
    float alpha = clamp(dense + strength.y * min(1.0, 2.0 * dense) * (1.0 - straight) * (1.0 - straight), 0.0, 1.0);
    vec3 lit = look.rgb * (0.45 + 0.6 * straight) * ((value & 128u) != 0u ? 0.7 : 1.0);
    float mm = span.x + float(keys[n]) * step_mm;
    float far = haze.z * clamp((mm - haze.x) / (haze.y - haze.x), 0.0, 1.0);
    sum += left * alpha * mix(lit, background, far);
    left *= 1.0 - alpha;
  }
  vec3 last = deepest < 65535u ? mix(solid.rgb, ink, darker) : background;
  result = vec4(sum + left * last, 1.0);
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
  for (let n = 0; n < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); n++) {
    const name = gl.getActiveUniform(program, n).name.replace("[0]", "");
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

// Return the five programs: a layer of a surface, the airway from inside, solid bodies, points, and all together.
export function programs(gl) {
  return {
    layer: linked(gl, SURFACE_VERTEX, LAYER_FRAGMENT),
    inside: linked(gl, SURFACE_VERTEX, INSIDE_FRAGMENT),
    solid: linked(gl, SOLID_VERTEX, SOLID_FRAGMENT),
    points: linked(gl, POINT_VERTEX, POINT_FRAGMENT),
    together: linked(gl, SCREEN_VERTEX, TOGETHER_FRAGMENT),
  };
}
