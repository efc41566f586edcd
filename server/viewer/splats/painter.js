// Painting with WebGL2: projection, ellipses from back to front, depth in colours, and trails on top.

import { FLOOR, LEVEL, PAINTS, ROW, programs } from "./programs.js";
import { Recent, TEXELS, interleave } from "./texels.js";
import { joined } from "./trails.js";
import { DEPTH_RAMP } from "../view/colours.js";

const FEWEST = 4096; // minimum capacity in Gaussians
const STATES = 3; // states that stay uploaded: those before and after the moment, and the previous one
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
const FRAMES_MORE = 32; // spare capacity for frames of trails, since live frames arrive one by one

export class Painter {
  /**
   * @param canvas canvas of the page or of a worker  @param headset whether the context is for a headset
   * @throws Error if the browser has no WebGL2
   */
  constructor(canvas, headset = false) {
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, preserveDrawingBuffer: true,
      powerPreference: "high-performance", xrCompatible: headset });
    if (!this.gl) throw new Error("this browser has no WebGL2");
    canvas.addEventListener?.("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener?.("webglcontextrestored", () => this.begin());
    this.begin();
  }

  /** Creates all WebGL objects; called again after the context was lost. */
  begin() {
    const { gl } = this;
    this.floats = ["EXT_color_buffer_float", "EXT_color_buffer_half_float"].some((name) => gl.getExtension(name) !== null);
    this.most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.programs = programs(gl);
    this.plain = gl.createVertexArray();
    this.room = this.count = this.width = this.height = 0;
    this.table = null; // colours that the `paints` texture has
    this.screen = { frame: null, x: 0, y: 0 }; // framebuffer and lower left corner of the finished picture
    this.target = null; // half floats if possible, to blend in; depth needs them
    this.copy = null; // of pixels that were painted without WebGL
    this.ellipses = this.trails = null;
    this.ramp = this.texture(gl.RGBA8, 256, 1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, Uint8Array.from(DEPTH_RAMP.flatMap((rgb) => [...rgb, 255])));
    this.one = new Uint8Array(4);
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    this.software = SOFTWARE.test(gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
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
    for (const target of [this.target, this.copy]) {
      gl.deleteFramebuffer(target?.frame ?? null);
      gl.deleteTexture(target?.picture ?? null);
    }
    this.target = this.copy = null;
  }

  reserve(count) {
    if (count <= this.room) return;
    const { gl } = this;
    const rows = Math.ceil(1.25 * Math.max(count, FEWEST) / ROW);
    if (rows > this.most) throw new Error(`this browser can draw at most ${ROW * this.most} Gaussians`);
    if (this.room) {
      for (const texture of [...this.uploaded, this.order, this.paints, ...this.ellipses.tables]) gl.deleteTexture(texture);
      gl.deleteFramebuffer(this.ellipses.frame);
    }
    this.room = rows * ROW;
    const texels = new Float32Array(4 * TEXELS * this.room);
    this.uploaded = Array.from({ length: STATES }, () => this.texture(gl.RGBA32F, TEXELS * ROW, rows));
    this.states = new Recent(this.uploaded, (texture, state) =>
      this.upload(texture, TEXELS, state.count, gl.RGBA, gl.FLOAT, state.texels ?? interleave(state, texels)));
    this.order = this.texture(gl.R32UI, ROW, rows);
    this.paints = this.texture(gl.RGBA8, ROW, rows);
    this.table = null;
    const tables = [0, 1].map(() => this.texture(gl.RGBA32UI, ROW, rows));
    this.ellipses = { tables, frame: gl.createFramebuffer() };
    const attachments = tables.map((_, k) => gl.COLOR_ATTACHMENT0 + k);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.ellipses.frame);
    tables.forEach((table, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, attachments[k], gl.TEXTURE_2D, table, 0));
    gl.drawBuffers(attachments);
  }

  /** Uploads the first rows of a texture with some texels per Gaussian. */
  upload(texture, texels, count, format, type, values) {
    const { gl } = this;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, texels * ROW, Math.ceil(count / ROW), format, type, values);
  }

  /**
   * Projects Gaussians to ellipses.
   *
   * @param moment { from, to, share }: states of the frames before and after it (`to` is null at a frame), and share [0, 1] of the way
   * @param camera camera in the internal world: rows, t, fx, fy, cx, cy, width, height, near in metres
   * @param order rows of the `count` Gaussians, farthest first  @param paint "own", "white", or their RGBA colours [4 N]
   */
  project({ from, to, share }, camera, { order, count }, paint) {
    const { gl } = this;
    this.count = count;
    if (!count) return;
    this.reserve((to ?? from).count);
    const before = this.states.of(from);
    const after = to ? this.states.of(to) : before;
    this.upload(this.order, 1, count, gl.RED_INTEGER, gl.UNSIGNED_INT, order);
    if (paint instanceof Uint8Array && paint !== this.table) {
      this.upload(this.paints, 1, this.room, gl.RGBA, gl.UNSIGNED_BYTE, padded(paint, 4 * this.room));
      this.table = paint;
    }
    const { program, places } = this.programs.projection;
    gl.useProgram(program);
    gl.bindVertexArray(this.plain);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.ellipses.frame);
    gl.viewport(0, 0, ROW, Math.ceil(count / ROW));
    this.bind([[places.before, before], [places.after, after], [places.order, this.order], [places.paints, this.paints]]);
    this.look(places, camera);
    gl.uniform1i(places.count, count);
    gl.uniform1i(places.known, from.count);
    gl.uniform1i(places.paint, PAINTS[paint] ?? PAINTS.table);
    gl.uniform1f(places.share, to ? share : 0);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Sets the uniforms of a camera. */
  look(places, camera) {
    const { gl } = this;
    gl.uniformMatrix3fv(places.turn, true, camera.rows.flat());
    gl.uniform3f(places.shift, ...camera.t);
    gl.uniform4f(places.lens, camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform3f(places.size, camera.width, camera.height, camera.near);
  }

  /**
   * Paints the projected ellipses, in half floats if possible, since 8 bits are too few for dozens of layers.
   *
   * @param background [red, green, blue] in [0, 1]
   */
  colours(background) {
    const { gl } = this;
    this.target ??= this.picture(this.floats ? gl.RGBA16F : gl.RGBA8);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.clearColor(...background, 1);
    this.blend(false);
    this.present(this.target, false);
  }

  /** Paints the depth of the projected ellipses; `range` of the colours, `nothing` where coverage is below half. */
  depth(range, nothing) {
    const { gl } = this;
    this.target ??= this.picture(gl.RGBA16F);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.frame);
    gl.clearColor(0, 0, 0, 0);
    this.blend(true);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const { program, places } = this.programs.depth;
    gl.useProgram(program);
    gl.bindVertexArray(this.plain);
    this.bind([[places.picture, this.target.picture], [places.ramp, this.ramp]]);
    gl.uniform2f(places.range, ...range);
    gl.uniform3f(places.nothing, ...nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** Framebuffer with a texture of the canvas's size. */
  picture(format) {
    const { gl } = this;
    const picture = this.texture(format, this.width, this.height);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
    return { picture, frame };
  }

  /** Shows RGBA pixels, the uppermost row first. */
  show(pixels) {
    const { gl, width, height } = this;
    this.copy ??= this.picture(gl.RGBA8);
    gl.bindTexture(gl.TEXTURE_2D, this.copy.picture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    this.present(this.copy, true);
  }

  /** Copies a picture to the screen; `down` if its first row is the uppermost. */
  present({ frame }, down) {
    const { gl, width, height, screen: { x, y } } = this;
    const [first, last] = down ? [y + height, y] : [y, y + height];
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, frame);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, this.screen.frame);
    gl.blitFramebuffer(0, 0, width, height, x, first, x + width, last, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height); // of the trails
  }

  /** Blends the ellipses, or their depths in place of red, into the current framebuffer. */
  blend(deep) {
    const { gl, width, height } = this;
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!this.count) return;
    const { program, places } = this.programs.gaussians;
    gl.useProgram(program);
    gl.bindVertexArray(this.plain);
    const [first, second] = this.ellipses.tables;
    this.bind([[places.places, first], [places.forms, second]]);
    gl.uniform2f(places.scale, 2 / width, -2 / height);
    gl.uniform1i(places.deep, deep ? 1 : 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArrays(gl.TRIANGLES, 0, 3 * this.count);
    gl.disable(gl.BLEND);
  }

  /** Reads the projected ellipses back: [4 N] texels of both tables, and the second as floats, farthest first. */
  read() {
    const { gl } = this;
    const rows = Math.ceil(this.count / ROW);
    const [places, forms] = [0, 1].map((k) => {
      const values = new Uint32Array(4 * ROW * rows);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.ellipses.frame);
      gl.readBuffer(gl.COLOR_ATTACHMENT0 + k);
      gl.readPixels(0, 0, ROW, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, values);
      return values;
    });
    return { places: new Float32Array(places.buffer), forms, depths: new Float32Array(forms.buffer) };
  }

  /** Place in the order of the Gaussian with the largest weight at a point of the picture; −1 if coverage is below half. */
  at(u, v) {
    if (!this.count) return -1;
    const { places, forms } = this.read();
    let [rest, best, most] = [1, -1, 0];
    for (let i = this.count - 1; i >= 0 && rest > 1e-3; i--) {
      const alpha = alphaAt(places, forms, 4 * i, u, v);
      if (alpha * rest > most) [most, best] = [alpha * rest, i];
      rest *= 1 - alpha;
    }
    return rest > 0.5 ? -1 : best;
  }

  /** 1st and 99th percentile of the depths of the ellipses, in metres. */
  range() {
    const { depths } = this.count ? this.read() : { depths: [] };
    const found = [];
    for (let i = this.count - 1; i >= 0; i--) if (depths[4 * i + 3] > 0) found.push(depths[4 * i + 3]);
    const nth = (share) => found[Math.min(found.length - 1, Math.floor(share * found.length))];
    return found.length ? [nth(0.01), nth(0.99)] : [0, 1];
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
    this.look(places, camera);
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

function padded(values, length) {
  const all = new Uint8Array(length);
  all.set(values);
  return all;
}

function alphaAt(places, forms, o, u, v) {
  const [x, y, ax, ay] = [u - places[o], v - places[o + 1], places[o + 2], places[o + 3]];
  const square = ax * ax + ay * ay;
  if (!square) return 0; // not in the picture
  const [ratio, level] = [(forms[o] & 0xffff) / 0xffff, -LEVEL * (forms[o] >>> 16) / 0xffff];
  const along = (x * ax + y * ay) / square;
  const across = (y * ax - x * ay) / square / ratio;
  const part = along * along + across * across;
  return part > 1 ? 0 : Math.min(0.99, 2 ** (level - (level + FLOOR) * part));
}
