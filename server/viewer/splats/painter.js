// Painting with WebGL2: ellipses from back to front, depth in colours, and trails on top.

import { ROW, programs } from "./programs.js";
import { STRIDE } from "./project.js";
import { joined } from "./trails.js";
import { DEPTH_RAMP } from "../view/colours.js";

const FEWEST = 4096; // minimum capacity in ellipses
const FRAMES_MORE = 32; // spare capacity for frames of trails, since live frames arrive one by one

export class Painter {
  /**
   * @param canvas canvas of the page or of a worker
   * @throws Error if the browser has no WebGL2
   */
  constructor(canvas) {
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("this browser has no WebGL2");
    canvas.addEventListener?.("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener?.("webglcontextrestored", () => this.begin());
    this.begin();
  }

  /** Creates all WebGL objects; called again after the context was lost. */
  begin() {
    const { gl } = this;
    this.floats = gl.getExtension("EXT_color_buffer_float") !== null && gl.getExtension("EXT_float_blend") !== null;
    this.most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.programs = programs(gl);
    this.plain = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    this.indices = gl.createBuffer();
    this.room = this.width = this.height = 0;
    this.target = null;
    this.trails = null;
    this.ramp = this.texture(gl.RGBA8, 256, 1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, Uint8Array.from(DEPTH_RAMP.flatMap((rgb) => [...rgb, 255])));
    this.one = new Uint8Array(4);
  }

  texture(format, width, height) {
    const { gl } = this;
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
    return made;
  }

  size(width, height) {
    if (this.width === width && this.height === height) return;
    const { gl } = this;
    Object.assign(this, { width, height });
    Object.assign(gl.canvas, { width, height });
    if (this.target) {
      gl.deleteFramebuffer(this.target.frame);
      gl.deleteTexture(this.target.picture);
    }
    this.target = null;
  }

  reserve(count) {
    if (count <= this.room) return;
    const { gl } = this;
    const rows = Math.ceil(1.25 * Math.max(count, FEWEST) / ROW);
    if (rows > this.most) throw new Error(`this browser can draw at most ${ROW * this.most} Gaussians`);
    this.room = rows * ROW;
    gl.deleteTexture(this.table ?? null);
    this.table = this.texture(gl.RGBA32F, 3 * ROW, rows);
    const corners = new Uint32Array(6 * this.room);
    for (let i = 0; i < this.room; i++) corners.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  }

  /**
   * Paints ellipses, farthest first.
   *
   * @param background [red, green, blue] in [0, 1]
   */
  colours(ellipses, count, background) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(...background, 1);
    this.ellipses(ellipses, count);
  }

  /** Paints depth, which is in place of red in the ellipses; `range` of the colours, `nothing` where coverage is below half. */
  depth(ellipses, count, range, nothing) {
    const { gl } = this;
    if (!this.target) {
      const picture = this.texture(gl.RGBA16F, this.width, this.height);
      const frame = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
      this.target = { picture, frame };
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.clearColor(0, 0, 0, 0);
    this.ellipses(ellipses, count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const { program, places } = this.programs.depth;
    gl.useProgram(program);
    gl.bindVertexArray(this.plain);
    this.bind([[places.picture, this.target.picture], [places.ramp, this.ramp]]);
    gl.uniform2f(places.range, ...range);
    gl.uniform3f(places.nothing, ...nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  ellipses(ellipses, count) {
    const { gl, width, height } = this;
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!count) return;
    this.reserve(count);
    const rows = Math.ceil(count / ROW);
    const { program, places } = this.programs.gaussians;
    gl.useProgram(program);
    gl.bindVertexArray(this.quads);
    this.bind([[places.table, this.table]]);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 3 * ROW, rows, gl.RGBA, gl.FLOAT, ellipses.subarray(0, STRIDE * ROW * rows));
    gl.uniform2f(places.scale, 2 / width, -2 / height);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
  }

  bind(textures) {
    const { gl } = this;
    textures.forEach(([place, texture], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform1i(place, unit);
    });
    gl.activeTexture(gl.TEXTURE0);
  }

  endTrails() {
    const { gl } = this;
    if (this.trails) for (const texture of [this.trails.centres, this.trails.hues]) gl.deleteTexture(texture);
    this.trails = null;
  }

  /**
   * Uploads the centres of trails in the frames of a sequence that are not uploaded yet; each texture row is a frame.
   *
   * @param ways { rows, hues, centres }  @param frames frames of the sequence, { index, reader }
   */
  placeTrails(ways, frames) {
    const { gl } = this;
    const count = ways.rows.length;
    if (!this.trails || this.trails.room < Math.min(frames.length, this.most)) this.beginTrails(ways.hues, frames.length);
    const { placed, room } = this.trails;
    const follows = joined(frames);
    gl.bindTexture(gl.TEXTURE_2D, this.trails.centres);
    for (let place = 0; place < Math.min(frames.length, room); place++) {
      const { index } = frames[place];
      const known = ways.centres.get(index);
      const row = known ? `${index} ${follows[place]}` : "";
      if ((placed[place] ?? "") === row) continue;
      placed[place] = row;
      const texels = known ? known.slice() : new Float32Array(4 * count); // frames that are not gathered yet have no points
      if (follows[place]) for (let i = 3; i < texels.length; i += 4) texels[i] *= 2; // 2: connected to the previous frame
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, place, count, 1, gl.RGBA, gl.FLOAT, texels);
    }
  }

  beginTrails(hues, frames) {
    const { gl } = this;
    this.endTrails();
    const count = hues.length / 3;
    const room = Math.min(this.most, Math.ceil(1.5 * frames) + FRAMES_MORE);
    this.trails = { count, room, placed: [], centres: this.texture(gl.RGBA32F, count, room), hues: this.texture(gl.RGBA8, count, 1) };
    const texels = new Uint8Array(4 * count);
    for (let i = 0; i < count; i++) texels.set(hues.subarray(3 * i, 3 * i + 3), 4 * i);
    gl.bindTexture(gl.TEXTURE_2D, this.trails.hues);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, count, 1, gl.RGBA, gl.UNSIGNED_BYTE, texels);
  }

  /** Paints the trails of the `span` frames before a place in the sequence, over the picture. */
  paintTrails(camera, now, span) {
    if (!this.trails || now <= 0 || Math.ceil(now) >= this.trails.room) return;
    const { gl } = this;
    const first = Math.max(0, Math.ceil(now) - span);
    const segments = Math.ceil(now) - first;
    const { program, places } = this.programs.trails;
    gl.useProgram(program);
    gl.bindVertexArray(this.plain);
    this.bind([[places.centres, this.trails.centres], [places.hues, this.trails.hues]]);
    gl.uniformMatrix3fv(places.turn, true, camera.rows.flat());
    gl.uniform3f(places.shift, ...camera.t);
    gl.uniform4f(places.lens, camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform3f(places.size, camera.width, camera.height, camera.near);
    gl.uniform1f(places.now, now);
    gl.uniform1i(places.trails, this.trails.count);
    gl.uniform1i(places.first, first);
    gl.uniform1i(places.span, span);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.LINES, 0, 2 * this.trails.count * segments);
    gl.disable(gl.BLEND);
  }

  /** Waits until the picture is finished, by reading back one pixel. */
  finish() {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, this.one);
  }
}
