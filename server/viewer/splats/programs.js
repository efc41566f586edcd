// WebGL2 programs, each with its two shaders.

import { FLOOR } from "./project.js";

export const ROW = 512; // ellipses per row of their texture, three texels each
const FLOOR_TEXT = FLOOR.toFixed(8);

// No instancing, because software WebGL takes as long for an instance as for a draw call.
const ELLIPSE = `#version 300 es
precision highp float;
precision highp sampler2D;
uniform sampler2D table;
uniform vec2 scale;
out vec2 at;
flat out vec4 shade;
void main() {
  int row = gl_VertexID >> 2;
  ivec2 texel = ivec2(3 * (row % ${ROW}), row / ${ROW});
  vec4 place = texelFetch(table, texel, 0);
  vec4 form = texelFetch(table, texel + ivec2(1, 0), 0);
  vec4 colour = texelFetch(table, texel + ivec2(2, 0), 0);
  vec2 corner = vec2(float(gl_VertexID & 1), float((gl_VertexID >> 1) & 1)) * 2.0 - 1.0;
  at = corner * sqrt(form.y + ${FLOOR_TEXT});
  shade = vec4(colour.rgb, form.y);
  vec2 pixel = place.xy + corner.x * place.zw + corner.y * form.x * vec2(-place.w, place.z);
  gl_Position = vec4(pixel * scale - vec2(1.0, -1.0), 0.0, 1.0);
}`;
const GAUSSIAN = `#version 300 es
precision highp float;
in vec2 at;
flat in vec4 shade;
out vec4 painted;
void main() {
  float level = shade.w - dot(at, at);
  float alpha = level < -${FLOOR_TEXT} ? 0.0 : min(0.99, exp2(level));
  painted = vec4(shade.rgb * alpha, alpha);
}`;

const SCREEN = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;
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

/** Compiles all programs: { gaussians, depth, trails }, each { program, places }, with uniform locations keyed by name. */
export function programs(gl) {
  return { gaussians: made(gl, ELLIPSE, GAUSSIAN), depth: made(gl, SCREEN, DEPTH), trails: made(gl, TRAIL, LINE) };
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
