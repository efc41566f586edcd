// Time of a sequence: plays at any speed, in circles, and says which place among the frames a time is.

const END_S = 0.4; // the last frame stays before it begins again

export class Clock {
  /** @param times of the frames, seconds, rising */
  constructor(times) {
    this.times = times;
    this.speed = 1;
    this.playing = false;
    this.set(times[0]);
  }

  get last() {
    return this.times.length - 1;
  }

  /** Goes to a time, seconds. */
  set(time) {
    this.time = Math.max(this.times[0], Math.min(this.times[this.last], time));
    this.rest = 0;
  }

  /** Place among the frames: 1.25 is a quarter of the way from the second to the third. */
  get place() {
    const { times, time } = this;
    let [low, high] = [0, this.last];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle;
      else high = middle;
    }
    const gap = times[high] - times[low];
    return gap > 0 ? low + Math.min(1, (time - times[low]) / gap) : high; // none where both have the same time
  }

  /** Goes to the next frame or the one before, and stops. */
  step(count) {
    this.playing = false;
    const at = count > 0 ? Math.floor(this.place + 1e-6) : Math.ceil(this.place - 1e-6);
    this.set(this.times[Math.max(0, Math.min(this.last, at + count))]);
  }

  /** Lets seconds of the wall pass. */
  pass(seconds) {
    if (!this.playing) return;
    const end = this.times[this.last];
    if (this.time < end) this.time = Math.min(end, this.time + seconds * this.speed);
    else if ((this.rest += seconds) > END_S) this.set(this.times[0]);
  }
}
