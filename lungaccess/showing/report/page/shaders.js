// The programs of the graphics card.

// A texel of a layer: red how near the focus, green and blue the depth, and in alpha how straight it is seen: from the
// outside 1/2 to 1, from the inside 1/2 to 0.  All in floats: whole numbers are slow where the processor draws.
const STORED_DEPTH = `
uniform vec2 span;
const float NOTHING = 65535.0;
float depthOf(float z) { return floor(clamp((-z - span.x) / (span.y - span.x), 0.0, 1.0) * 65534.0 + 0.5); }
vec2 twoBytes(float depth) { float high = floor(depth / 256.0); return vec2(high, depth - 256.0 * high) / 255.0; }
float stored(vec4 texel) { return floor(texel.g * 65280.0 + texel.b * 255.0 + 0.5); }`;

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
uniform int slice, peeled;
uniform sampler2DArray before;
out vec4 result;
${STORED_DEPTH}
void main() {
  if (kept < 0.0) discard;
  float depth = depthOf(eye.z);
  if (peeled != 0 && depth <= stored(texelFetch(before, ivec3(gl_FragCoord.xy, slice), 0))) discard;
  result = vec4(near, twoBytes(depth), 0.5 - 0.5 * dot(normalize(facing), normalize(eye)));
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
in vec3 eye, facing, colour;
uniform float number, lamp;
layout(location=0) out vec4 result;
layout(location=1) out vec4 known;
${STORED_DEPTH}
void main() {
  float straight = abs(dot(normalize(facing), normalize(eye)));
  vec3 lit = colour * (0.35 + 0.65 * straight) + vec3(0.25) * pow(straight, 24.0);
  lit /= 1.0 + lamp * dot(eye, eye);
  result = vec4(lit, 1.0);
  known = vec4(number, twoBytes(depthOf(eye.z)), 0.0);
}`;

// A point is a disc that is shaded as a ball.  Alpha says that it has no outline: many small ones would be all outline.
const POINT_VERTEX = `#version 300 es
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
}`;

const POINT_FRAGMENT = `#version 300 es
precision highp float;
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
  known = vec4(number, twoBytes(depthOf(centre.z + straight * ball)), 1.0);
}`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;

export const MOST_SLICES = 16;

// All layers of a pixel put together, an outline around solid bodies, and haze with the distance.  The structures of
// the second layer are the first of those of the first layer.  Nothing is sorted: of each layer as much is seen as those
// before it let through, which is the same and takes no lists, which are slow where the processor draws.
function togetherFragment(firsts, seconds) {
  const slots = [
    ...Array.from({ length: firsts }, (_, n) => ["first", n]), ...Array.from({ length: seconds }, (_, n) => ["second", n]),
  ];
  const last = slots.length;
  const layer = ([from, n], k) => `
  texel = texelFetch(${from}, ivec3(at, ${n}), 0);
  float d${k} = stored(texel);
  vec4 c${k} = look(looks[${n}], texel, d${k}, deepest);
  d${k} += ${(k / 64).toFixed(4)};`;
  const before = (k) => [...slots, null].map((_, j) => (j === k ? "" : ` * (d${j} < d${k} ? 1.0 - c${j}.a : 1.0)`)).join("");
  return `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray first, second;
uniform sampler2D solids, known;
uniform vec4 looks[${MOST_SLICES}];
uniform vec3 background, ink, haze, dense;
uniform float outline, step_mm;
out vec4 result;
${STORED_DEPTH}
// Colour and density of a place: denser where it is seen from the side, and near the focus; paler far away.
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
  vec4 c${last} = vec4(ink, 0.0), texel;
  ivec2 end = textureSize(known, 0) - 1, low = max(at - int(outline), 0), high = min(at + int(outline), end);
  float d${last} = min(min(outlined(ivec2(high.x, at.y)), outlined(ivec2(low.x, at.y))),
    min(outlined(ivec2(at.x, high.y)), outlined(ivec2(at.x, low.y)))) - 0.5;
  float edge = (deepest - d${last}) * step_mm > 0.8 ? 0.75 : 0.0;
  if (deepest < NOTHING) behind = mix(behind, ink, edge);
  else c${last}.a = edge;${slots.map(layer).join("")}
  vec3 sum = ${[...slots, null].map((_, k) => `c${k}.rgb * (c${k}.a${before(k)})`).join("\n    + ")};
  result = vec4(sum + behind${[...slots, null].map((_, k) => ` * (1.0 - c${k}.a)`).join("")}, 1.0);
}`;
}

// Return a program: a function that takes it into use and sets its uniforms; it has no use for others.
function linked(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const setters = {};
  for (let n = 0; n < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); n++) {
    const { name, type } = gl.getActiveUniform(program, n), place = gl.getUniformLocation(program, name);
    const setter = { [gl.FLOAT]: "uniform1f", [gl.FLOAT_VEC2]: "uniform2fv", [gl.FLOAT_VEC3]: "uniform3fv", [gl.FLOAT_VEC4]: "uniform4fv" }[type];
    setters[name.replace("[0]", "")] = (value) =>
      (type === gl.FLOAT_MAT4 ? gl.uniformMatrix4fv(place, false, value) : gl[setter || "uniform1i"](place, value));
  }
  return (uniforms) => {
    gl.useProgram(program);
    for (const [name, value] of Object.entries(uniforms)) if (setters[name]) setters[name](value);
  };
}

// Return the five programs: a layer of a surface, the airway from inside, solid bodies, points, and what puts layers
// together, which is made for their numbers.
export function programs(gl) {
  const made = new Map();
  return {
    layer: linked(gl, SURFACE_VERTEX, LAYER_FRAGMENT),
    inside: linked(gl, SURFACE_VERTEX, INSIDE_FRAGMENT),
    solid: linked(gl, SOLID_VERTEX, SOLID_FRAGMENT),
    points: linked(gl, POINT_VERTEX, POINT_FRAGMENT),
    together: (firsts, seconds) => {
      const key = `${firsts} ${seconds}`;
      if (!made.has(key)) made.set(key, linked(gl, SCREEN_VERTEX, togetherFragment(firsts, seconds)));
      return made.get(key);
    },
  };
}
