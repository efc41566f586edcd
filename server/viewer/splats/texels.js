// Attributes of a state that pictures depend on, Gaussian by Gaussian.

export const TEXELS = 4; // texels of four floats per Gaussian: centre and opacity (0: retired); then three axes, each with a component of the colour

/** Interleaves the attributes of a state into 16 floats per Gaussian, and returns them. */
export function interleave({ count, means, factors, colours, opacities, retired }, texels) {
  for (let i = 0, to = 0; i < count; i++, to += 4 * TEXELS) {
    for (let k = 0; k < 3; k++) {
      texels[to + k] = means[k * count + i];
      const axis = to + 4 + 4 * k;
      for (let j = 0; j < 3; j++) texels[axis + j] = factors[(3 * j + k) * count + i];
      texels[axis + 3] = colours[k * count + i];
    }
    texels[to + 3] = retired[i] ? 0 : opacities[i];
  }
  return texels;
}

/** Buffers with the most recently used states, each of which is filled again only for another state. */
export class Recent {
  /** @param buffers at least one more than are used at once  @param fill (buffer, state) */
  constructor(buffers, fill) {
    this.slots = buffers.map((buffer) => ({ state: null, buffer })); // least recently used first
    this.fill = fill;
  }

  of(state) {
    const place = this.slots.findIndex((one) => one.state === state);
    const [slot] = this.slots.splice(Math.max(0, place), 1);
    this.slots.push(slot);
    if (place < 0) this.fill(slot.buffer, state);
    slot.state = state;
    return slot.buffer;
  }
}
