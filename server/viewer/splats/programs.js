// WebGL2 programs, each with its two shaders.

import { TEXELS } from "./texels.js";

export const ROW = 512; // Gaussians per row of a texture
export const FLOOR = Math.log2(255); // a Gaussian is cut off where its alpha is 1/255
export const LEVEL = 8; // log2 opacity is stored as a share of −LEVEL
export const PAINTS = { own: 0, white: 1, table: 2 };
export const LOW_PASS = 0.3; // pixels², so that nothing is thinner than about a pixel
export const MARGIN = 0.3; // margin as a share of half the picture's size, beyond which the slope of the projection is clamped

const SCREEN = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;

// EWA splatting with the conventions of scas4d_core/rasterize. Each fragment projects one Gaussian to an ellipse, because a
// vertex shader would do it for every corner. Integer targets, because WebGL2 can render to them without extensions.
// An ellipse has its centre and half axis (pixels); short/long axis ratio and log2 opacity; colour; depth.
const PROJECTION = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
uniform sampler2D before;
uniform sampler2D after;
uniform sampler2D paints;
uniform usampler2D order;
uniform int count;
uniform int known;
uniform int paint;
uniform float share;
uniform mat3 turn;
uniform vec3 shift;
uniform vec4 lens;
uniform vec3 size;
layout(location = 0) out uvec4 place;
layout(location = 1) out uvec4 form;
mat4 gaussian(sampler2D state, int row) {
  ivec2 at = ivec2(${TEXELS} * (row % ${ROW}), row / ${ROW});
  return mat4(texelFetch(state, at, 0), texelFetch(state, at + ivec2(1, 0), 0), texelFetch(state, at + ivec2(2, 0), 0),
    texelFetch(state, at + ivec2(3, 0), 0));
}
void main() {
  place = form = uvec4(0); // without extent, so not drawn
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (at.y * ${ROW} + at.x >= count) return;
  int row = int(texelFetch(order, at, 0).r);
  mat4 found = row < known ? gaussian(before, row) : mat4(0.0);
  float opacity = found[0].w;
  if (share > 0.0) { // Gaussians that are born or retired between two frames fade in or out
    mat4 next = gaussian(after, row);
    if (opacity == 0.0) {
      opacity = share * next[0].w;
      found = next;
    } else if (next[0].w == 0.0) opacity *= 1.0 - share;
    else found += share * (next - found);
  }
  vec3 seen = turn * found[0].xyz + shift;
  if (opacity < 1.0 / 255.0 || !(seen.z >= size.z)) return;
  vec2 slope = seen.xy / seen.z;
  vec2 margin = ${(MARGIN / 2).toFixed(3)} * size.xy;
  vec2 clamped = clamp(slope, (-lens.zw - margin) / lens.xy, (size.xy - lens.zw + margin) / lens.xy);
  vec3 s = vec3(${LOW_PASS}, 0.0, ${LOW_PASS}); // covariance: xx, xy, yy
  for (int k = 1; k < 4; k++) {
    vec3 axis = turn * found[k].xyz;
    vec2 d = lens.xy / seen.z * (axis.xy - clamped * axis.z);
    s += vec3(d.x * d.x, d.x * d.y, d.y * d.y);
  }
  float level = log2(opacity);
  float reach = ${(2 * Math.LN2).toFixed(8)} * (level + ${FLOOR.toFixed(8)});
  vec2 pixel = lens.xy * slope + lens.zw;
  vec2 extent = sqrt(reach * s.xz) + 0.5;
  if (any(lessThanEqual(pixel + extent, vec2(0.0))) || any(greaterThanEqual(pixel - extent, size.xy))) return;
  float difference = (s.x - s.z) / 2.0;
  float spread = length(vec2(difference, s.y));
  vec2 axis = difference >= 0.0 ? vec2(difference + spread, s.y) : vec2(s.y, spread - difference); // eigenvector
  axis = spread > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  float middle = (s.x + s.z) / 2.0;
  float ratio = sqrt(max(middle - spread, ${LOW_PASS}) / (middle + spread));
  vec3 colour = paint == ${PAINTS.own} ? vec3(found[1].w, found[2].w, found[3].w)
    : paint == ${PAINTS.white} ? vec3(1.0) : texelFetch(paints, ivec2(row % ${ROW}, row / ${ROW}), 0).rgb;
  place = floatBitsToUint(vec4(pixel, sqrt(reach * (middle + spread)) * axis));
  form = uvec4(packUnorm2x16(vec2(ratio, level / ${-LEVEL}.0)), packHalf2x16(colour.rg), packHalf2x16(vec2(colour.b)), floatBitsToUint(seen.z));
}`;

// One triangle around each ellipse, because software WebGL takes as long for a small triangle as for a hundred pixels.
// No instancing, because it takes as long for an instance as for a draw call.
const ELLIPSE = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D places;
uniform usampler2D forms;
uniform vec2 scale;
uniform bool deep;
out vec2 at;
flat out vec4 shade;
void main() {
  int row = gl_VertexID / 3;
  int corner = gl_VertexID - 3 * row;
  ivec2 texel = ivec2(row % ${ROW}, row / ${ROW});
  vec4 place = uintBitsToFloat(texelFetch(places, texel, 0));
  uvec4 form = texelFetch(forms, texel, 0);
  vec2 shape = unpackUnorm2x16(form.x);
  float level = ${-LEVEL}.0 * shape.y;
  vec2 unit = corner == 0 ? vec2(0.0, 2.0) : vec2(corner == 1 ? -1.7320508 : 1.7320508, -1.0);
  at = unit * sqrt(level + ${FLOOR.toFixed(8)});
  shade = vec4(deep ? vec3(uintBitsToFloat(form.w), 0.0, 0.0) : vec3(unpackHalf2x16(form.y), unpackHalf2x16(form.z).x), level);
  vec2 pixel = place.xy + unit.x * place.zw + unit.y * shape.x * vec2(-place.w, place.z);
  gl_Position = vec4(pixel * scale - vec2(1.0, -1.0), 0.0, 1.0);
}`;
const GAUSSIAN = `#version 300 es
precision highp float;
in vec2 at;
flat in vec4 shade;
out vec4 painted;
void main() {
  float level = shade.w - dot(at, at);
  float alpha = level < -${FLOOR.toFixed(8)} ? 0.0 : min(0.99, exp2(level));
  painted = vec4(shade.rgb * alpha, alpha);
}`;
const DEPTH = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform sampler2D ramp;
uniform vec2 range;
uniform vec3 nothing;
out vec4 painted;
void main() {
  vec4 found = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
  float level = clamp((found.r / max(found.a, 1e-6) - range.x) / max(range.y - range.x, 1e-9), 0.0, 1.0);
  painted = vec4(found.a < 0.5 ? nothing : texelFetch(ramp, ivec2(int(level * 255.0), 0), 0).rgb, 1.0);
}`;

// A trail segment has two vertices. The texture has the centres, with one column per trail and one row per frame. Its
// alpha is 1 if the point exists, or 2 if it also continues the previous row.
const TRAIL = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D centres;
uniform sampler2D hues;
uniform mat3 turn;
uniform vec3 shift;
uniform vec4 lens;
uniform vec3 size;
uniform float now;
uniform int trails;
uniform int first;
uniform int span;
out vec4 shade;
void main() {
  int segment = gl_VertexID >> 1;
  int trail = segment % trails;
  int frame = first + segment / trails;
  vec4 begin = texelFetch(centres, ivec2(trail, frame), 0);
  vec4 end = texelFetch(centres, ivec2(trail, frame + 1), 0);
  float ahead = (gl_VertexID & 1) == 0 ? 0.0 : min(1.0, now - float(frame));
  vec3 seen = turn * mix(begin.xyz, end.xyz, ahead) + shift;
  bool there = begin.w > 0.5 && end.w > 1.5 && seen.z > size.z;
  float age = (now - float(frame) - ahead) / float(span);
  shade = vec4(texelFetch(hues, ivec2(trail, 0), 0).rgb, 1.0) * (0.7 * (1.0 - age));
  vec2 pixel = lens.xy * seen.xy / max(seen.z, 1e-9) + lens.zw;
  gl_Position = there ? vec4(pixel * vec2(2.0, -2.0) / size.xy - vec2(1.0, -1.0), 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;
const LINE = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 painted;
void main() { painted = shade; }`;

/** Compiles all programs: { projection, gaussians, depth, trails }, each { program, places }, with uniform locations keyed by name. */
export function programs(gl) {
  return { projection: made(gl, SCREEN, PROJECTION), gaussians: made(gl, ELLIPSE, GAUSSIAN), depth: made(gl, SCREEN, DEPTH), trails: made(gl, TRAIL, LINE) };
}

function made(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`WebGL: ${gl.getProgramInfoLog(program)}`);
  }
  const places = {};
  for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(program, i);
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}
