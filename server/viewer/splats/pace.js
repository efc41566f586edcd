// How large pictures are while something moves: software WebGL takes its time by the pixel.

const TARGET_MS = 90;
const SMALLEST = 0.4; // of the sides
const MOST_DENSE = 1.5; // pixels of the picture a pixel of the page
const MOST_PIXELS = 1.4e6;

export class Pace {
  constructor() {
    this.share = 1;
  }

  /** Width and height for a box of the page: whole at rest, smaller while it moves where the browser is slow. */
  size(box, moving) {
    const dense = Math.min(window.devicePixelRatio || 1, MOST_DENSE) * (moving ? this.share : 1);
    const [width, height] = [Math.max(16, box.width * dense), Math.max(16, box.height * dense)];
    const over = Math.max(1, Math.sqrt(width * height / MOST_PIXELS));
    return [Math.round(width / over), Math.round(height / over)];
  }

  /** Takes what a picture took that was drawn while something moved. */
  took(milliseconds, share) {
    const wanted = share * Math.sqrt(TARGET_MS / Math.max(milliseconds, 1));
    this.share = Math.max(SMALLEST, Math.min(1, 0.6 * this.share + 0.4 * wanted));
  }
}
