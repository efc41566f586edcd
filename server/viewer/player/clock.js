// Clock of a sequence, which plays in a loop at any speed and converts times to places among the frames.

const END_S = 0.4; // how long the last frame is shown before the loop restarts

export class Clock {
  /** @param times times of the frames in seconds, ascending */
  constructor(times) {
    this.times = times;
    this.speed = 1;
    this.playing = false;
    this.set(times[0]);
  }

  get last() {
    return this.times.length - 1;
  }

  /** Sets the time in seconds. */
  set(time) {
    this.time = Math.max(this.times[0], Math.min(this.times[this.last], time));
    this.rest = 0;
  }

  /** Fractional place among the frames: 1.25 is a quarter of the way from the second frame to the third. */
  get place() {
    const { times, time } = this;
    let [low, high] = [0, this.last];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle;
      else high = middle;
    }
    const gap = times[high] - times[low];
    return gap > 0 ? low + Math.min(1, (time - times[low]) / gap) : high; // frames with equal times
  }

  /** Goes to the next or previous frame and stops. */
  step(count) {
    this.playing = false;
    const at = count > 0 ? Math.floor(this.place + 1e-6) : Math.ceil(this.place - 1e-6);
    this.set(this.times[Math.max(0, Math.min(this.last, at + count))]);
  }

  /** Advances by seconds of wall-clock time. */
  pass(seconds) {
    if (!this.playing) return;
    const end = this.times[this.last];
    if (this.time < end) this.time = Math.min(end, this.time + seconds * this.speed);
    else if ((this.rest += seconds) > END_S) this.set(this.times[0]);
  }
}
