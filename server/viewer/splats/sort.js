// Order of Gaussians by depth: a radix sort of quantized depths, with buffers that are reused.

import { ROW } from "./programs.js";

const DIGIT = 11;
const BUCKETS = 1 << DIGIT;
const LEVELS = BUCKETS * BUCKETS; // of depth, each 0.03 mm in a scene of 100 m

export class Sorter {
  constructor() {
    this.capacity = 0;
    this.sorted = []; // what the last order depends on
    this.histogram = new Uint32Array(2 * BUCKETS);
  }

  reserve(count) {
    if (count <= this.capacity) return;
    this.capacity = ROW * Math.ceil(1.25 * count / ROW); // whole rows of the painter's texture
    this.depths = new Float32Array(this.capacity);
    for (const name of ["keys", "order", "spare"]) this[name] = new Uint32Array(this.capacity);
  }

  /**
   * Sorts the visible Gaussians of a moment into the first `count` entries of `order`, farthest first.
   *
   * @param moment { from, to, share }: states of the frames before and after it (`to` is null at a frame), and share [0, 1] of the way
   * @param axis [3] direction of view  @param hidden [N], or null
   */
  sort({ from, to, share }, axis, hidden) {
    const asked = [from, to, share, hidden, ...axis];
    if (asked.every((one, k) => one === this.sorted[k])) return; // the position and the lens do not affect the order
    this.sorted = asked;
    const last = to ?? from;
    this.reserve(last.count);
    const { depths, keys, spare, histogram } = this;
    const [x, y, z] = axis;
    const [{ means: m0, count: known }, { means: m1, count }] = [from, last];
    let [n, low, high] = [0, Infinity, -Infinity];
    for (let i = count - 1; i >= 0; i--) { // of equal depths, the last row counts as the farthest, as in the CPU rasterizer
      if (hidden !== null && hidden[i]) continue;
      const before = i < known && !from.retired[i];
      const after = !last.retired[i];
      if (!before && !after) continue;
      const start = before ? x * m0[i] + y * m0[known + i] + z * m0[2 * known + i] : 0;
      const end = after ? x * m1[i] + y * m1[count + i] + z * m1[2 * count + i] : 0;
      const depth = !before ? end : !after ? start : start + share * (end - start);
      depths[n] = depth;
      spare[n++] = i;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    histogram.fill(0);
    const scale = high > low ? (LEVELS - 1) / (high - low) : 0;
    for (let k = 0; k < n; k++) {
      const key = (high - depths[k]) * scale | 0;
      keys[spare[k]] = key;
      histogram[key & (BUCKETS - 1)]++;
      histogram[BUCKETS + (key >>> DIGIT)]++;
    }
    for (const shift of [0, DIGIT]) this.scatter(n, shift);
    [this.order, this.spare] = [this.spare, this.order];
    this.count = n;
  }

  /** Sorts the rows in `spare` by one digit of their keys, and exchanges `spare` and `order`. */
  scatter(count, shift) {
    const { keys, order, spare } = this;
    const starts = this.histogram.subarray(shift ? BUCKETS : 0, shift ? 2 * BUCKETS : BUCKETS);
    for (let k = 0, sum = 0; k < BUCKETS; k++) {
      const size = starts[k];
      starts[k] = sum;
      sum += size;
    }
    for (let k = 0; k < count; k++) {
      const row = spare[k];
      order[starts[(keys[row] >>> shift) & (BUCKETS - 1)]++] = row;
    }
    [this.order, this.spare] = [spare, order];
  }
}
