// The programs of the graphics card, whose texts lie in shaders/.
import { GLSL } from "./glsl.js";

export const MOST_SLICES = 16;

// Return the definitions of together.frag for its layers.  The structures of the second layer are the first of those of
// the first layer.
function definitionsOf(firsts, seconds) {
  const layers = ["first", "second"].flatMap((from, k) => Array.from({ length: [firsts, seconds][k] }, (_, n) => `${from}, ${n}`));
  const each = (of) => layers.map(of).join(" ");
  return `#define MOST_SLICES ${MOST_SLICES}
#define LAYERS ${each((layer, k) => `LAYER(${layer}, c${k}, d${k}, ${(k / 64).toFixed(4)})`)}
#define THROUGH_LAYERS(reached) ${each((_, k) => `* THROUGH(c${k}, d${k}, reached)`)}
#define SUM_OF_LAYERS ${each((_, k) => `+ c${k}.rgb * (c${k}.a * THROUGH_ALL(d${k}))`)}`;
}

// Return a program: a function that takes it into use and sets its uniforms; it has no use for others.
function linked(gl, vertex, fragment, definitions = "") {
  const program = gl.createProgram();
  for (const [kind, name] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    // The version has to stand first.
    gl.shaderSource(shader, GLSL[name].replace("\n", `\n${definitions}\n`));
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`${name}: ${gl.getShaderInfoLog(shader)}`);
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
    layer: linked(gl, "surface.vert", "layer.frag"),
    inside: linked(gl, "surface.vert", "inside.frag"),
    solid: linked(gl, "solid.vert", "solid.frag"),
    points: linked(gl, "point.vert", "point.frag"),
    together: (...counts) => {
      const key = counts.join(" ");
      if (!made.has(key)) made.set(key, linked(gl, "screen.vert", "together.frag", definitionsOf(...counts)));
      return made.get(key);
    },
  };
}
