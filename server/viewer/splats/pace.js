// Size of pictures while something moves, since software WebGL takes time in proportion to the pixels.

const TARGET_MS = 90;
const SMALLEST = 0.4; // minimum scale of the sides
const MOST_DENSE = 1.5; // maximum pixels of the picture per pixel of the page
const MOST_PIXELS = 1.4e6;

export class Pace {
  constructor() {
    this.share = 1;
  }

  /** Width and height of a picture for a box of the page: full size at rest, smaller during motion if the browser is slow. */
  size(box, moving) {
    const dense = Math.min(window.devicePixelRatio || 1, MOST_DENSE) * (moving ? this.share : 1);
    const [width, height] = [Math.max(16, box.width * dense), Math.max(16, box.height * dense)];
    const over = Math.max(1, Math.sqrt(width * height / MOST_PIXELS));
    return [Math.round(width / over), Math.round(height / over)];
  }

  /** Records how long a picture took that was drawn during motion. */
  took(milliseconds, share) {
    const wanted = share * Math.sqrt(TARGET_MS / Math.max(milliseconds, 1));
    this.share = Math.max(SMALLEST, Math.min(1, 0.6 * this.share + 0.4 * wanted));
  }
}
