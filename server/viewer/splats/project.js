// Projection of Gaussians to ellipses, farthest first: EWA splatting with the conventions of scas4d_core/rasterize.

export const STRIDE = 12; // floats per ellipse: centre, half axis (pixels); short/long axis ratio, log2 opacity; colour; padding
export const FLOOR = Math.log2(255); // a Gaussian is cut off where its alpha is 1/255
const LOW_PASS = 0.3; // pixels², so that nothing is thinner than about a pixel
const MARGIN = 0.3; // margin as a share of half the picture's size, beyond which the slope of the projection is clamped
const REACH = 2 * Math.LN2;
const DIGIT = 11;
const BUCKETS = 1 << DIGIT;

/** Projector with buffers that grow with the scene; each canvas has its own. */
export class Projector {
  constructor() {
    this.capacity = 0;
    this.count = 0; // ellipses in the last picture
    this.histogram = new Uint32Array(3 * BUCKETS);
  }

  reserve(count) {
    if (count <= this.capacity) return;
    this.capacity = 512 * Math.ceil(1.25 * count / 512); // whole rows of the painter's texture
    this.found = new Float32Array(STRIDE * this.capacity);
    this.ellipses = new Float32Array(STRIDE * this.capacity); // sorted
    this.depths = new Float32Array(this.capacity);
    this.rows = new Uint32Array(this.capacity); // rows of the Gaussians, unsorted
    this.order = new Uint32Array(this.capacity);
    this.spare = new Uint32Array(this.capacity);
  }

  /**
   * Projects a moment of a scene into the first `count` entries of `ellipses`, farthest first.
   *
   * @param moment { from, to, share }: states of the frames before and after it (`to` is null at a frame), and share [0, 1] of the way
   * @param camera camera in the internal world: rows, t, fx, fy, cx, cy, width, height, near in metres
   * @param look { colours [3 N] of the Gaussians, or null for their own; depth: whether z is in place of red; hidden [N] or null }
   */
  project({ from, to, share }, camera, look) {
    const last = to ?? from;
    const { count } = last;
    this.reserve(count);
    const { found, depths, rows } = this;
    const [[r00, r01, r02], [r10, r11, r12], [r20, r21, r22]] = camera.rows;
    const [t0, t1, t2] = camera.t;
    const { fx, fy, cx, cy, width, height, near } = camera;
    const [lowX, highX] = [-(cx / fx + MARGIN * width / (2 * fx)), (width - cx) / fx + MARGIN * width / (2 * fx)];
    const [lowY, highY] = [-(cy / fy + MARGIN * height / (2 * fy)), (height - cy) / fy + MARGIN * height / (2 * fy)];
    const { means: m0, factors: f0, colours: c0, count: known } = from;
    const { means: m1, factors: f1, colours: c1 } = last;
    const mixed = to !== null && share > 0;
    const { colours: painted, depth, hidden } = look;
    const { opacities } = last;
    const g = new Float64Array(9);
    let n = 0;
    for (let i = 0; i < count; i++) {
      if (hidden !== null && hidden[i]) continue;
      let opacity = opacities[i];
      // Gaussians that are born or retired between two frames fade in or out.
      const before = i < known && !from.retired[i];
      const after = !last.retired[i];
      if (!before && !after) continue;
      const blend = mixed && before && after;
      if (!before) opacity *= mixed ? share : 0;
      else if (!after) opacity *= 1 - share;
      if (opacity < 1 / 255) continue;
      const own = before ? m0 : m1;
      const size = before ? known : count;
      let px = own[i];
      let py = own[size + i];
      let pz = own[2 * size + i];
      if (blend) {
        px += share * (m1[i] - px);
        py += share * (m1[count + i] - py);
        pz += share * (m1[2 * count + i] - pz);
      }
      const z = r20 * px + r21 * py + r22 * pz + t2;
      if (!(z >= near)) continue;
      const inverse = 1 / z;
      const u = (r00 * px + r01 * py + r02 * pz + t0) * inverse;
      const v = (r10 * px + r11 * py + r12 * pz + t1) * inverse;
      const axes = before ? f0 : f1;
      for (let k = 0; k < 9; k++) {
        g[k] = axes[k * size + i];
        if (blend) g[k] += share * (f1[k * count + i] - g[k]);
      }
      const clampedU = u < lowX ? lowX : u > highX ? highX : u;
      const clampedV = v < lowY ? lowY : v > highY ? highY : v;
      let sxx = LOW_PASS;
      let sxy = 0;
      let syy = LOW_PASS;
      for (let k = 0; k < 3; k++) {
        const along = r20 * g[k] + r21 * g[3 + k] + r22 * g[6 + k];
        const x = fx * inverse * (r00 * g[k] + r01 * g[3 + k] + r02 * g[6 + k] - clampedU * along);
        const y = fy * inverse * (r10 * g[k] + r11 * g[3 + k] + r12 * g[6 + k] - clampedV * along);
        sxx += x * x;
        sxy += x * y;
        syy += y * y;
      }
      const level = Math.log2(opacity);
      const reach = REACH * (level + FLOOR);
      const x = fx * u + cx;
      const y = fy * v + cy;
      const halfX = Math.sqrt(reach * sxx) + 0.5;
      const halfY = Math.sqrt(reach * syy) + 0.5;
      if (!(x + halfX > 0 && x - halfX < width && y + halfY > 0 && y - halfY < height)) continue;
      // Half axes: eigenvectors times the extent of the Gaussian along them.
      const middle = (sxx + syy) / 2;
      const spread = Math.sqrt(((sxx - syy) / 2) ** 2 + sxy * sxy);
      const long = Math.sqrt(reach * (middle + spread));
      const short = Math.sqrt(reach * Math.max(middle - spread, LOW_PASS));
      let ax = sxx >= syy ? (sxx - syy) / 2 + spread : sxy;
      let ay = sxx >= syy ? sxy : (syy - sxx) / 2 + spread;
      const length = Math.hypot(ax, ay);
      if (length > 0) {
        ax /= length;
        ay /= length;
      } else [ax, ay] = [1, 0];
      const o = STRIDE * n;
      found[o] = x;
      found[o + 1] = y;
      found[o + 2] = ax * long;
      found[o + 3] = ay * long;
      found[o + 4] = short / long;
      found[o + 5] = level;
      if (depth) found[o + 8] = z;
      else if (painted !== null) {
        for (let k = 0; k < 3; k++) found[o + 8 + k] = painted[3 * i + k];
      } else {
        const shade = before ? c0 : c1;
        for (let k = 0; k < 3; k++) {
          const value = shade[k * size + i];
          found[o + 8 + k] = blend ? value + share * (c1[k * count + i] - value) : value;
        }
      }
      depths[n] = z;
      rows[n++] = i;
    }
    this.count = n;
    this.sort();
  }

  /** Sorts by depth, then by row, with a radix sort of the bits of the floats, which have the same order. */
  sort() {
    const { count, histogram } = this;
    const keys = new Uint32Array(this.depths.buffer, 0, count);
    histogram.fill(0);
    for (let i = 0; i < count; i++) {
      const key = keys[i];
      histogram[key & (BUCKETS - 1)]++;
      histogram[BUCKETS + ((key >>> DIGIT) & (BUCKETS - 1))]++;
      histogram[2 * BUCKETS + (key >>> (2 * DIGIT))]++;
    }
    let [order, spare] = [this.order, this.spare];
    for (let i = 0; i < count; i++) order[i] = i;
    for (let pass = 0; pass < 3; pass++) {
      const from = pass * BUCKETS;
      for (let k = 0, sum = 0; k < BUCKETS; k++) {
        const size = histogram[from + k];
        histogram[from + k] = sum;
        sum += size;
      }
      for (let i = 0; i < count; i++) {
        const one = order[i];
        spare[histogram[from + ((keys[one] >>> (pass * DIGIT)) & (BUCKETS - 1))]++] = one;
      }
      [order, spare] = [spare, order];
    }
    [this.order, this.spare] = [order, spare];
    const { found, ellipses } = this;
    for (let i = 0; i < count; i++) {
      const to = STRIDE * (count - 1 - i);
      const at = STRIDE * order[i];
      for (let k = 0; k < STRIDE; k++) ellipses[to + k] = found[at + k];
    }
  }

  /** Gaussian with the largest weight at a point of the picture: { row, z }; null if coverage is below half. */
  at(u, v) {
    let [rest, best, most] = [1, -1, 0];
    for (let i = 0; i < this.count && rest > 1e-3; i++) {
      const alpha = alphaAt(this.found, STRIDE * this.order[i], u, v);
      if (alpha * rest > most) [most, best] = [alpha * rest, this.order[i]];
      rest *= 1 - alpha;
    }
    return rest > 0.5 || best < 0 ? null : { row: this.rows[best], z: this.depths[best] };
  }

  /** 1st and 99th percentile of the depths, in metres. */
  range() {
    const nth = (share) => this.depths[this.order[Math.min(this.count - 1, Math.floor(share * this.count))]];
    return this.count ? [nth(0.01), nth(0.99)] : [0, 1];
  }
}

function alphaAt(e, o, u, v) {
  const [x, y, ax, ay] = [u - e[o], v - e[o + 1], e[o + 2], e[o + 3]];
  const square = ax * ax + ay * ay;
  const along = (x * ax + y * ay) / square;
  const across = (y * ax - x * ay) / square / e[o + 4];
  const part = along * along + across * across;
  return part > 1 ? 0 : Math.min(0.99, 2 ** (e[o + 5] - (e[o + 5] + FLOOR) * part));
}
