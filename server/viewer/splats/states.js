// Decoding of a compact 4D file: newborn Gaussians without a reference, and states relative to a reference (docs/format.md).
// A state is { count, means [3 N], factors [9 N], rotations [4 N], colours [3 N], foreground [N], opacities [N], retired [N], ids [N] },
// component by component. Its arrays are shared between states and must not be modified. Gloss is skipped, so highlights are not drawn.

import { FileError } from "./records.js";
import { Sections } from "./planes.js";
import { nearestTurn, turnBy } from "./turns.js";

const MOST_CLUSTERS = 400;
const MARGIN = 0.95;
const SCALE_STEP = Math.fround(0.08);
const LABELS = 64;
const OPAQUE = 1e-4;
const CHANGING = [["means", 3], ["factors", 9], ["rotations", 4], ["colours", 3], ["foreground", 1], ["retired", 1]];
const turnStep = (bounds) => 2 * bounds.rotation / Math.sqrt(3);
const levelOf = (label) => Math.max(0, Math.min(LABELS - 1, Math.ceil(LABELS * label) - 1));
const label = (level) => (Math.max(0, Math.min(LABELS - 1, level)) + 0.5) / LABELS;

/** Fills an array with a function of another array's values; several times as fast as `from`. */
function each(found, values, of) {
  for (let i = 0; i < found.length; i++) found[i] = of(values[i]);
  return found;
}

/** Decodes newborn Gaussians after the count in a record: { state, clusters, gloss }; gloss is the number with gloss, −1 without gloss sections. */
export function decodeBorn(body, at, count, bounds) {
  const sections = new Sections(body, at);
  const ids = new Float64Array(count);
  const steps = sections.plane(count);
  for (let i = 0, id = 0; i < count; i++) ids[i] = id += steps[i];
  const clusters = sections.plane(count);
  if (clusters.some((one) => one < 0 || one > MOST_CLUSTERS)) throw new FileError("a cluster is out of range");
  const planes = (components) => sections.residuals(components, count) ?? Array.from({ length: components }, () => new Int32Array(count));
  const [lengths, axes, centres, turns, shades] = [planes(3), planes(9), planes(3), planes(3), planes(3)];
  const [levels, opaque] = [planes(1)[0], planes(1)[0]];
  const factors = new Float32Array(9 * count);
  const axisStep = 2 * Math.min(0.02, bounds.axes / 4);
  const units = lengths.map((plane) => each(new Float64Array(count), plane, (length) => axisStep * 2 ** (length / 8)));
  const sizes = new Float32Array(count);
  for (let k = 0; k < 9; k++) {
    const [plane, scale, from] = [axes[k], units[k % 3], k * count];
    for (let i = 0; i < count; i++) {
      const value = plane[i] * scale[i];
      factors[from + i] = value;
      sizes[i] += value * value;
    }
  }
  for (let i = 0; i < count; i++) sizes[i] = Math.sqrt(sizes[i] / 3);
  const means = new Float32Array(3 * count);
  const step = 2 * bounds.position / 4 * MARGIN;
  for (let k = 0; k < 3; k++) for (let i = 0; i < count; i++) means[k * count + i] = centres[k][i] * (step * sizes[i]);
  const rotations = new Float32Array(4 * count).fill(1, 0, count);
  turnBy(turns, turnStep(bounds), rotations, null);
  const colours = new Float32Array(3 * count);
  addColours(shades, 2 * bounds.colour / 4, colours, count);
  const opacities = each(new Float32Array(count), opaque, (value) => Math.max(OPAQUE, Math.min(1 - OPAQUE, value * 2 * bounds.opacity)));
  const state = { count, ids, means, factors, rotations, colours, opacities, foreground: each(new Float32Array(count), levels, label),
    retired: new Uint8Array(count) };
  const gloss = finish(sections, state, true);
  return { state, clusters, gloss };
}

/** Reads the end of a body: exact rows, retired Gaussians, gloss (only for newborn ones; its number is returned) and mirrored ones. */
function finish(sections, state, born) {
  const { count } = state;
  const exact = sections.exact(count, 12);
  if (exact) {
    state.means = state.means.slice();
    state.factors = state.factors.slice();
    const { rows, values } = exact;
    rows.forEach((row, i) => {
      for (let k = 0; k < 12; k++) {
        const value = values[k * rows.length + i];
        if (k < 3) state.means[k * count + row] = value;
        else state.factors[(k - 3) * count + row] = value;
      }
    });
  }
  state.retired = sections.mask(count) ?? state.retired;
  let gloss = -1;
  if (born) {
    gloss = sections.plane(1)[0] - 1;
    if (gloss < -1 || gloss > count) throw new FileError(`the number of Gaussians with gloss, ${gloss}, is not between 0 and ${count}`);
    if (gloss >= 0) sections.residuals(3, gloss);
  }
  sections.skipArray();
  sections.done();
  return gloss;
}

/** State extended by the Gaussians of `born` that follow its own. */
export function extended(state, born) {
  const found = { ...born };
  for (const [name, components] of CHANGING) {
    const all = (found[name] = born[name].slice());
    for (let k = 0; k < components; k++) all.set(state[name].subarray(k * state.count, (k + 1) * state.count), k * born.count);
  }
  return found;
}

/** Concatenates two states. */
export function appended(state, more) {
  const count = state.count + more.count;
  const found = { count };
  for (const [name, components] of [...CHANGING, ["ids", 1], ["opacities", 1]]) {
    const all = (found[name] = new state[name].constructor(components * count));
    for (let k = 0; k < components; k++) {
      all.set(state[name].subarray(k * state.count, (k + 1) * state.count), k * count);
      all.set(more[name].subarray(k * more.count, (k + 1) * more.count), k * count + state.count);
    }
  }
  return found;
}

/** Decodes a state relative to a reference; the first `gloss` Gaussians may have gloss, −1 if the file has no gloss. */
export function decodeState(body, at, reference, clusters, bounds, gloss) {
  const sections = new Sections(body, at);
  const { count } = reference;
  const [linear, shift] = [sections.double(), sections.double()];
  if (!Number.isFinite(linear) || !Number.isFinite(shift)) throw new FileError("the step sizes of a state are not finite");
  let most = 0;
  for (let i = 0; i < count; i++) if (clusters[i] > most) most = clusters[i];
  const motion = Array.from({ length: 12 }, () => sections.plane(most));
  const state = { ...reference };
  if (most) carry(state, clusters, most, motion, linear, shift);
  const sizes = sizesOf(state);
  const own = (name) => (state[name] === reference[name] ? (state[name] = state[name].slice()) : state[name]);
  const scales = sections.residuals(1, count)?.[0];
  if (scales) {
    const factors = own("factors");
    for (let i = 0; i < count; i++) {
      if (!scales[i]) continue;
      const scale = Math.fround(Math.exp(SCALE_STEP * Math.max(-500, Math.min(500, scales[i]))));
      sizes[i] *= scale;
      for (let k = 0; k < 9; k++) factors[k * count + i] *= scale;
    }
  }
  const turns = sections.residuals(3, count);
  if (turns) turnBy(turns, turnStep(bounds), own("rotations"), own("factors"));
  for (const [name, components, bound] of [["factors", 9, bounds.axes], ["means", 3, bounds.position]]) {
    const planes = sections.residuals(components, count);
    if (!planes) continue;
    const array = own(name);
    const step = Math.fround(2 * bound * MARGIN);
    planes.forEach((plane, k) => {
      for (let i = 0, j = k * count; i < count; i++, j++) if (plane[i]) array[j] += plane[i] * step * sizes[i];
    });
  }
  const shades = sections.residuals(3, count);
  if (shades) addColours(shades, 2 * bounds.colour, own("colours"), count);
  const levels = sections.residuals(1, count)?.[0];
  if (levels) {
    const foreground = own("foreground");
    for (let i = 0; i < count; i++) foreground[i] = label(levelOf(foreground[i]) + levels[i]);
  }
  if (gloss >= 0) sections.residuals(3, gloss);
  finish(sections, state, false);
  return state;
}

function addColours([green, red, blue], step, colours, count) {
  for (let i = 0; i < count; i++) {
    colours[i] += (red[i] + green[i]) * step;
    colours[count + i] += green[i] * step;
    colours[2 * count + i] += (blue[i] + green[i]) * step;
  }
}

function sizesOf({ factors, count }) {
  const sizes = new Float32Array(count);
  for (let k = 0; k < 9; k++) for (let i = 0, j = k * count; i < count; i++, j++) sizes[i] += factors[j] * factors[j];
  for (let i = 0; i < count; i++) sizes[i] = Math.sqrt(sizes[i] / 3);
  return sizes;
}

/** Moves the centres, axes and rotations of a state with its clusters; Gaussians without a cluster stay in place. */
function carry(state, clusters, most, motion, linear, shift) {
  const { count, means: before, factors: axes, rotations: turns } = state;
  const centres = new Float64Array(3 * (most + 1));
  const members = new Float64Array(most + 1);
  for (let i = 0; i < count; i++) {
    const c = clusters[i];
    members[c]++;
    for (let k = 0; k < 3; k++) centres[3 * c + k] += before[k * count + i];
  }
  const maps = new Float32Array(19 * (most + 1)); // matrix, centre, end, quaternion
  for (let c = 1; c <= most; c++) {
    const m = Array.from({ length: 9 }, (_, k) => motion[k][c - 1] * linear + (k % 4 ? 0 : 1));
    maps.set(m, 19 * c);
    for (let k = 0; k < 3; k++) {
      const centre = centres[3 * c + k] / Math.max(members[c], 1);
      maps[19 * c + 9 + k] = centre;
      maps[19 * c + 12 + k] = motion[9 + k][c - 1] * shift + centre;
    }
    maps.set(nearestTurn(m), 19 * c + 15);
  }
  const [means, factors, rotations] = [before.slice(), axes.slice(), turns.slice()];
  for (let i = 0; i < count; i++) {
    if (!clusters[i]) continue;
    const o = 19 * clusters[i];
    const x = before[i] - maps[o + 9];
    const y = before[count + i] - maps[o + 10];
    const z = before[2 * count + i] - maps[o + 11];
    for (let k = 0; k < 3; k++) {
      const [m0, m1, m2] = [maps[o + 3 * k], maps[o + 3 * k + 1], maps[o + 3 * k + 2]];
      means[k * count + i] = m0 * x + m1 * y + m2 * z + maps[o + 12 + k];
      for (let j = 0; j < 3; j++) {
        factors[(3 * k + j) * count + i] = m0 * axes[j * count + i] + m1 * axes[(3 + j) * count + i] + m2 * axes[(6 + j) * count + i];
      }
    }
    const [w, p, q, r] = [maps[o + 15], maps[o + 16], maps[o + 17], maps[o + 18]];
    const [a, b, c, d] = [turns[i], turns[count + i], turns[2 * count + i], turns[3 * count + i]];
    rotations[i] = w * a - p * b - q * c - r * d;
    rotations[count + i] = w * b + p * a + q * d - r * c;
    rotations[2 * count + i] = w * c - p * d + q * a + r * b;
    rotations[3 * count + i] = w * d + p * c - q * b + r * a;
  }
  Object.assign(state, { means, factors, rotations });
}
