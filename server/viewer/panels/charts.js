// Chart of a figure over the frames, drawn as SVG so that it stays sharp.

const NS = "http://www.w3.org/2000/svg";
const [LEFT, RIGHT, TOP, BOTTOM] = [38, 8, 8, 16];

export function element(name, attributes, parent) {
  const made = document.createElementNS(NS, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  parent?.append(made);
  return made;
}

/** Step of 1, 2 or 5 times a power of ten that divides a span into about `count` steps. */
export function step(span, count) {
  const rough = span / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * ([1, 2, 5].find((k) => k * power >= rough) ?? 10);
}

/** The point with the largest value at each place, since thousands of bars would cover each other. */
function highest(points, placeOf) {
  const found = new Map();
  for (const point of points) {
    const place = placeOf(point);
    if (!(found.get(place)?.value >= point.value)) found.set(place, point);
  }
  return found.values();
}

export class Chart {
  /**
   * @param svg element to draw into
   * @param kind "line" or "bars"
   * @param unit unit of the values
   * @param pick called with the index of a frame that is clicked
   */
  constructor(svg, kind, unit, pick) {
    Object.assign(this, { svg, kind, unit, points: [], chosen: null });
    svg.addEventListener("click", (event) => {
      const point = this.nearest(event);
      if (point) pick(point.index);
    });
    this.note = element("title", {});
    this.cursor = element("line", { class: "chosen" });
    svg.addEventListener("pointermove", (event) => {
      const point = this.nearest(event);
      const why = point && [point.fault, point.rejected, point.change].filter((one) => one).join("; ");
      this.note.textContent = point ? `frame ${point.index}: ${this.text(point.value)}${why ? `; ${why}` : ""}` : "";
    });
    new ResizeObserver(() => this.draw()).observe(svg);
  }

  text(value) {
    return value === null ? "not measured" : `${value.toFixed(value < 10 ? 2 : 1)} ${this.unit}`;
  }

  /** @param points [{index, value, fault, rejected, change}] in order; a value may be null, and the last three are reasons for marks, if any */
  set(points) {
    this.points = points;
    this.draw();
  }

  choose(index) {
    if (this.chosen === index) return;
    this.chosen = index;
    this.mark();
  }

  /** Moves the line at the chosen frame. */
  mark() {
    this.cursor.setAttribute("visibility", this.chosen === null ? "hidden" : "visible");
    if (this.chosen === null || !this.cursor.parentNode) return;
    const x = this.x({ index: this.chosen });
    for (const end of ["x1", "x2"]) this.cursor.setAttribute(end, x);
  }

  nearest(event) {
    const box = this.svg.getBoundingClientRect();
    const x = event.clientX - box.left;
    let best = null;
    for (const point of this.points) if (!best || Math.abs(this.x(point) - x) < Math.abs(this.x(best) - x)) best = point;
    return best;
  }

  x(point) {
    return LEFT + (point.index - this.first + 0.5) / this.count * this.width;
  }

  draw() {
    const { clientWidth, clientHeight } = this.svg;
    this.svg.replaceChildren(this.note);
    if (!clientWidth) return;
    this.svg.setAttribute("viewBox", `0 0 ${clientWidth} ${clientHeight}`);
    const known = this.points.filter((point) => point.value !== null);
    if (!known.length) {
      element("text", { x: clientWidth / 2, y: clientHeight / 2 + 4, class: "empty" }, this.svg).textContent =
        "after the first update";
      return;
    }
    this.first = this.points[0].index;
    this.count = Math.max(this.points.at(-1).index - this.first + 1, 8);
    this.width = clientWidth - LEFT - RIGHT;
    const height = clientHeight - TOP - BOTTOM;
    const values = known.map((point) => point.value);
    let [low, high] = [Math.min(...values), Math.max(...values)];
    let clipped = () => false;
    if (this.kind === "bars") {
      low = 0;
      // A frame that had to wait for a compiler would make all others invisible, so its bar is cut off at the top.
      const median = [...values].sort((a, b) => a - b)[values.length >> 1];
      const usual = Math.max(...values.filter((value) => value <= 5 * median));
      clipped = (value) => value > 5 * median;
      high = usual;
    }
    const pad = this.kind === "bars" ? 0 : Math.max(0.12 * (high - low), 0.5);
    [low, high] = [low - pad, high + Math.max(pad, 0.08 * (high - low), 1e-6)];
    const tick = step(high - low, 3);
    const y = (value) => TOP + (high - value) / (high - low) * height;
    for (let value = Math.ceil(low / tick) * tick; value <= high; value += tick) {
      element("line", { x1: LEFT, x2: clientWidth - RIGHT, y1: y(value), y2: y(value), class: "grid" }, this.svg);
      element("text", { x: LEFT - 5, y: y(value) + 3.5, class: "label end" }, this.svg).textContent =
        value.toFixed(Math.max(0, -Math.floor(Math.log10(tick) + 1e-9)));
    }
    const every = Math.max(1, step(this.count, 6));
    for (let index = Math.ceil(this.first / every) * every; index < this.first + this.count; index += every) {
      element("text", { x: this.x({ index }), y: clientHeight - 3, class: "label" }, this.svg).textContent = index;
    }
    for (const [end, value] of [["y1", TOP], ["y2", TOP + height]]) this.cursor.setAttribute(end, value);
    this.svg.append(this.cursor);
    this.mark();
    if (this.kind === "bars") {
      const wide = Math.max(1, Math.min(14, 0.7 * this.width / this.count));
      for (const point of highest(known, (one) => Math.round(this.x(one)))) {
        const top = clipped(point.value) ? TOP - 4 : y(point.value);
        element("rect", { x: this.x(point) - wide / 2, width: wide, y: top, rx: Math.min(1.5, wide / 3),
          height: TOP + height - top, class: clipped(point.value) ? "bar beyond" : "bar" }, this.svg);
        if (clipped(point.value)) {
          element("text", { x: this.x(point) + wide / 2 + 4, y: TOP + 6, class: "label start" }, this.svg).textContent =
            this.text(point.value);
        }
      }
    } else {
      const path = known.map((point, i) => `${i ? "L" : "M"}${this.x(point)} ${y(point.value)}`).join("");
      element("path", { d: path, class: "line" }, this.svg);
      if (known.length < 60) {
        for (const point of known) element("circle", { cx: this.x(point), cy: y(point.value), r: 2.4, class: "dot" }, this.svg);
      }
    }
    for (const point of this.points.filter((one) => one.change)) {
      const x = this.x({ index: point.index - 0.5 });
      element("line", { x1: x, x2: x, y1: TOP - 4, y2: TOP + height, class: "change" }, this.svg);
    }
    for (const point of this.points.filter((one) => one.rejected)) {
      element("path", { d: `M${this.x(point)} ${TOP + height - 8}l4.5 4l-4.5 4l-4.5 -4z`, class: "rejected" }, this.svg);
    }
    for (const point of this.points.filter((one) => one.fault)) {
      element("path", { d: `M${this.x(point)} ${TOP + height - 7}l4.5 7h-9z`, class: "fault" }, this.svg);
    }
  }
}
