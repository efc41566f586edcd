// Colours of depth, tracks and charts.

// Viridis at 9 points, interpolated linearly: far is dark, near is bright, and it is readable for the colour-blind.
const VIRIDIS = [[68, 1, 84], [71, 44, 122], [59, 81, 139], [44, 113, 142], [33, 144, 141], [39, 173, 129],
  [92, 200, 99], [170, 220, 50], [253, 231, 37]];

/** Depth colours, 256 x RGB. */
export const DEPTH_RAMP = Array.from({ length: 256 }, (_, i) => {
  const at = (255 - i) / 255 * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(at), VIRIDIS.length - 2);
  return VIRIDIS[low].map((value, k) => Math.round(value + (at - low) * (VIRIDIS[low + 1][k] - value)));
});

/** Okabe and Ito's palette without black, distinguishable on dark and light backgrounds and by the colour-blind. */
export const TRACKS = ["#e69f00", "#56b4e9", "#00c896", "#f0e442", "#4c8dff", "#ff6b3d", "#e285c2", "#f2f4f7"];

/** Converts depth [H, W] float32 (NaN: nothing) into an image; its colours range from the 1st to the 99th percentile. */
export function paintDepth(depth, width, height, empty) {
  const stride = Math.max(1, Math.floor(depth.length / 20000));
  const sample = [];
  for (let i = 0; i < depth.length; i += stride) if (Number.isFinite(depth[i])) sample.push(depth[i]);
  sample.sort((a, b) => a - b);
  const near = sample[Math.floor(0.01 * sample.length)] ?? 0;
  const far = sample[Math.floor(0.99 * (sample.length - 1))] ?? 1;
  const word = ([red, green, blue]) => (255 << 24 | blue << 16 | green << 8 | red) >>> 0;
  const ramp = Uint32Array.from(DEPTH_RAMP, word);
  const nothing = word(empty);
  const image = new ImageData(width, height);
  const words = new Uint32Array(image.data.buffer);
  const span = 255 / Math.max(far - near, 1e-12);
  for (let i = 0; i < words.length; i++) {
    const level = (depth[i] - near) * span;
    words[i] = level === level ? ramp[level < 0 ? 0 : level > 255 ? 255 : level | 0] : nothing;
  }
  return { image, near, far };
}
