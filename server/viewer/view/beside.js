// Picture beside the live view: a camera's picture of the current frame, its rendering, or the difference between them.

import { DEPTH_RAMP } from "./colours.js";
import { fetched, scenePath } from "../service.js";
import { page } from "../page.js";

const STRONGER = 3; // amplification of differences, which are shown around grey
const HOTTEST = 0.25; // upper end of the heat map, as a share of the range
const WORDS = {
  picture: "as sent",
  render: "rendered",
  difference: `rendered minus sent, amplified ${STRONGER} times around grey`,
  heat: `difference, 0 (dark) to ${100 * HOTTEST}% (bright) of the range`,
};

export class Beside {
  /** @param box element with a canvas and a caption */
  constructor(box) {
    this.box = box;
    this.canvas = box.querySelector("canvas");
    this.context = this.canvas.getContext("2d", { willReadFrequently: true });
    this.caption = box.querySelector("figcaption");
    this.what = "";
    this.camera = 0;
    this.wanted = this.shown = "";
  }

  /** Chooses what to show: "" for nothing, or a key of `WORDS`. */
  choose(what) {
    this.what = what;
    this.box.hidden = !what;
    this.draw(this.frame);
  }

  /** Chooses the camera, given its index in the rig. */
  look(camera) {
    this.camera = camera;
    this.draw(this.frame);
  }

  close() {
    this.abort?.abort();
    this.frame = undefined;
    this.wanted = this.shown = "";
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.caption.textContent = "";
  }

  /** Draws a frame; while one is being loaded, only the newest request is kept. */
  async draw(frame) {
    this.frame = frame;
    if (!this.what || frame === undefined || !page.rig) return;
    const { name } = page.rig.cameras[this.camera] ?? page.rig.cameras[0];
    this.wanted = JSON.stringify([page.scene, page.opened, this.what, name, frame]);
    if (this.busy) return;
    this.busy = true;
    while (this.wanted && this.wanted !== this.shown) {
      const wish = this.wanted;
      try {
        await this.show(wish);
      } catch (error) {
        if (wish === this.wanted && error.name !== "AbortError") this.say(JSON.parse(wish), error.message);
      }
      this.shown = wish;
    }
    this.busy = false;
  }

  async show(wish) {
    const [scene, , what, name, frame] = JSON.parse(wish);
    const [own, made] = await Promise.all([what === "render" ? null : this.own(scene, name, frame), what === "picture" ? null : this.made(scene, name, frame)]);
    if (wish !== this.wanted) return;
    const { width, height } = made ?? own;
    Object.assign(this.canvas, { width, height });
    const { context } = this;
    if (!own || !made) context.drawImage(own ?? made, 0, 0, width, height);
    else {
      const pixels = (bitmap) => {
        context.drawImage(bitmap, 0, 0, width, height);
        return context.getImageData(0, 0, width, height);
      };
      const [sent, rendered] = [pixels(own), pixels(made)];
      context.putImageData((what === "heat" ? heat : difference)(rendered, sent), 0, 0);
    }
    this.caption.textContent = `Camera ${name}, frame ${frame}: ${WORDS[what]}`;
    Object.assign(this.box.dataset, { what, camera: name, frame, size: `${width}x${height}` });
  }

  say([, , , name, frame], words) {
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.caption.textContent = `Camera ${name}, frame ${frame}: ${words}`;
    delete this.box.dataset.frame;
  }

  async own(scene, name, frame) {
    const address = `${scenePath(scene)}/frames/${frame}/cameras/${encodeURIComponent(name)}`;
    return createImageBitmap(await (await fetched("GET", address, undefined, this.signal())).blob());
  }

  async made(scene, name, frame) {
    const size = page.rig.cameras.find((camera) => camera.name === name).width;
    const query = new URLSearchParams({ camera: name, frame, format: "png", width: Math.min(size, 960) });
    return createImageBitmap(await (await fetched("GET", `${scenePath(scene)}/render?${query}`, undefined, this.signal())).blob());
  }

  signal() {
    this.abort ??= new AbortController();
    if (this.abort.signal.aborted) this.abort = new AbortController();
    return this.abort.signal;
  }
}

function difference(rendered, sent) {
  const out = new ImageData(rendered.width, rendered.height);
  for (let i = 0; i < out.data.length; i++) {
    out.data[i] = i % 4 === 3 ? 255 : 128 + STRONGER * (rendered.data[i] - sent.data[i]);
  }
  return out;
}

function heat(rendered, sent) {
  const out = new ImageData(rendered.width, rendered.height);
  for (let i = 0; i < out.data.length; i += 4) {
    const off = Math.max(...[0, 1, 2].map((k) => Math.abs(rendered.data[i + k] - sent.data[i + k]))) / 255;
    const shade = DEPTH_RAMP[255 - Math.min(255, Math.round(255 * off / HOTTEST))];
    out.data.set([...shade, 255], i);
  }
  return out;
}
