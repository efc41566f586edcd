// Painting without a GPU: a scanline rasterizer, nearest Gaussian first. Several times as fast as software WebGL, which takes
// long for each triangle and pixel, and cannot skip covered pixels. Same conventions as the shaders of programs.js.

import { LOW_PASS, MARGIN } from "./programs.js";
import { Recent, TEXELS, interleave } from "./texels.js";

const STATES = 3;
const LEAST = 1 / 255; // alpha below which a Gaussian is cut off
const MOST = 0.99;
const COVERED = 0.5 / 255; // transmittance below which further Gaussians are invisible
const STEPS = 4096; // of the table of exponentials
const SCALE = STEPS / (2 * Math.log(1 / LEAST));
const FALLOFF = Float32Array.from({ length: STEPS + 8 }, (_, k) => Math.exp(-0.5 * (k + 0.5) / SCALE));

export class Rasterizer {
  constructor() {
    this.room = 0;
    this.sums = new Float32Array(0); // red, green, blue and transmittance of each pixel
    this.pixels = new Uint8Array(0);
  }

  /**
   * Paints Gaussians; arguments as in `Painter.project`.
   *
   * @returns RGBA pixels, valid until the next call
   */
  paint({ from, to, share }, camera, { order, count }, paint, background) {
    this.begin((to ?? from).count, camera.width * camera.height);
    const { sums, pixels } = this;
    const before = this.states.of(from);
    const after = to ? this.states.of(to) : before;
    const mixed = to !== null && share > 0;
    const [[r00, r01, r02], [r10, r11, r12], [r20, r21, r22]] = camera.rows;
    const [t0, t1, t2] = camera.t;
    const { fx, fy, cx, cy, width, height, near } = camera;
    const [marginX, marginY] = [MARGIN / 2 * width, MARGIN / 2 * height];
    const [lowX, highX] = [(-cx - marginX) / fx, (width - cx + marginX) / fx];
    const [lowY, highY] = [(-cy - marginY) / fy, (height - cy + marginY) / fy];
    for (let i = count - 1; i >= 0; i--) {
      const row = order[i];
      const o = 4 * TEXELS * row;
      let own = before;
      let opacity = row < from.count ? before[o + 3] : 0;
      let way = 0;
      if (mixed) { // Gaussians that are born or retired between two frames fade in or out
        const next = after[o + 3];
        if (opacity === 0) [own, opacity] = [after, share * next];
        else if (next === 0) opacity *= 1 - share;
        else way = share;
      }
      if (opacity < LEAST) continue;
      const px = own[o] + way * (after[o] - own[o]);
      const py = own[o + 1] + way * (after[o + 1] - own[o + 1]);
      const pz = own[o + 2] + way * (after[o + 2] - own[o + 2]);
      const z = r20 * px + r21 * py + r22 * pz + t2;
      if (!(z >= near)) continue;
      const inverse = 1 / z;
      const u = (r00 * px + r01 * py + r02 * pz + t0) * inverse;
      const v = (r10 * px + r11 * py + r12 * pz + t1) * inverse;
      const clampedU = u < lowX ? lowX : u > highX ? highX : u;
      const clampedV = v < lowY ? lowY : v > highY ? highY : v;
      let sxx = LOW_PASS;
      let sxy = 0;
      let syy = LOW_PASS;
      for (let k = o + 4; k < o + 16; k += 4) {
        const g0 = own[k] + way * (after[k] - own[k]);
        const g1 = own[k + 1] + way * (after[k + 1] - own[k + 1]);
        const g2 = own[k + 2] + way * (after[k + 2] - own[k + 2]);
        const along = r20 * g0 + r21 * g1 + r22 * g2;
        const x = fx * inverse * (r00 * g0 + r01 * g1 + r02 * g2 - clampedU * along);
        const y = fy * inverse * (r10 * g0 + r11 * g1 + r12 * g2 - clampedV * along);
        sxx += x * x;
        sxy += x * y;
        syy += y * y;
      }
      const reach = 2 * Math.log(opacity / LEAST);
      const centreX = fx * u + cx;
      const centreY = fy * v + cy;
      const [halfX, halfY] = [Math.sqrt(reach * sxx), Math.sqrt(reach * syy)];
      const top = Math.max(0, Math.ceil(centreY - halfY - 0.5));
      const bottom = Math.min(height - 1, Math.floor(centreY + halfY - 0.5));
      if (top > bottom || centreX + halfX < 0 || centreX - halfX > width) continue;
      let [red, green, blue] = [1, 1, 1];
      if (paint === "own") {
        red = own[o + 7] + way * (after[o + 7] - own[o + 7]);
        green = own[o + 11] + way * (after[o + 11] - own[o + 11]);
        blue = own[o + 15] + way * (after[o + 15] - own[o + 15]);
      } else if (paint !== "white") [red, green, blue] = [paint[4 * row] / 255, paint[4 * row + 1] / 255, paint[4 * row + 2] / 255];
      const slope = sxy / syy;
      const spread = syy / (sxx * syy - sxy * sxy); // x² of the inverse covariance
      for (let y = top; y <= bottom; y++) {
        const dy = y + 0.5 - centreY;
        const least = dy * dy / syy;
        if (least >= reach) continue;
        const middle = centreX + slope * dy - 0.5;
        const half = Math.sqrt((reach - least) / spread);
        const left = Math.max(0, Math.ceil(middle - half));
        const right = Math.min(width - 1, Math.floor(middle + half));
        const dx = left - middle;
        let distance = (least + spread * dx * dx) * SCALE; // changes along the row by steps that grow by a constant
        let step = spread * (2 * dx + 1) * SCALE;
        const growth = 2 * spread * SCALE;
        for (let at = 4 * (y * width + left), end = 4 * (y * width + right); at <= end; at += 4) {
          const rest = sums[at + 3];
          if (rest > COVERED) {
            let alpha = opacity * FALLOFF[distance | 0];
            if (alpha > MOST) alpha = MOST;
            const weight = alpha * rest;
            sums[at] += weight * red;
            sums[at + 1] += weight * green;
            sums[at + 2] += weight * blue;
            sums[at + 3] = rest - weight;
          }
          distance += step;
          step += growth;
        }
      }
    }
    for (let at = 0; at < pixels.length; at += 4) {
      const rest = sums[at + 3];
      for (let k = 0; k < 3; k++) pixels[at + k] = 255 * Math.min(1, Math.max(0, sums[at + k] + rest * background[k])) + 0.5;
    }
    return pixels;
  }

  begin(count, pixels) {
    if (count > this.room) {
      this.room = Math.ceil(1.25 * count);
      const buffers = Array.from({ length: STATES }, () => new Float32Array(4 * TEXELS * this.room));
      this.states = new Recent(buffers, (buffer, state) => interleave(state, buffer));
    }
    if (4 * pixels !== this.pixels.length) {
      this.sums = new Float32Array(4 * pixels);
      this.pixels = new Uint8Array(4 * pixels).fill(255);
    }
    this.sums.fill(0);
    for (let at = 3; at < this.sums.length; at += 4) this.sums[at] = 1;
  }
}
