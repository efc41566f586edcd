// List of parts, each of which can be shown, hidden, or shown alone.

import { node } from "../page.js";
import { partColour } from "../splats/rig.js";

export class PartList {
  /** @param changed called with the labels of the hidden parts; −1 stands for Gaussians that belong to no part */
  constructor(list, words, changed) {
    Object.assign(this, { list, words, changed, hidden: new Set(), labels: [] });
  }

  /** Lists `count` parts and the rest, or nothing if there are none; if the number has changed, all parts are shown. */
  show(count) {
    const labels = count ? [...Array(count).keys(), -1] : [];
    if (labels.length !== this.labels.length) this.hidden.clear();
    this.labels = labels;
    this.list.replaceChildren(...this.labels.map((label) => this.row(label)));
    this.mark();
  }

  row(label) {
    const name = label < 0 ? "no part" : `part ${label + 1}`;
    const box = node("input", { type: "checkbox", "aria-label": `Show ${name}`, onchange: () => this.toggle(label, !box.checked) });
    const swatch = node("span", { class: "swatch" });
    swatch.style.background = label < 0 ? "#5a6068" : `rgb(${partColour(label)})`;
    const only = node("button", { type: "button", "aria-label": `Show ${name} alone`, onclick: () => this.alone(label) }, "alone");
    return node("li", { "data-label": label }, node("label", {}, box, swatch, name[0].toUpperCase() + name.slice(1)), only);
  }

  toggle(label, hide) {
    if (hide) this.hidden.add(label);
    else this.hidden.delete(label);
    this.describe();
  }

  /** Shows one part alone, or all parts if it is already shown alone. */
  alone(label) {
    const alone = this.isAlone(label);
    this.hidden = new Set(alone ? [] : this.labels.filter((one) => one !== label));
    this.describe();
  }

  isAlone(label) {
    return this.hidden.size === this.labels.length - 1 && !this.hidden.has(label);
  }

  describe() {
    this.mark();
    this.changed([...this.hidden]);
  }

  mark() {
    for (const row of this.list.children) {
      const label = Number(row.dataset.label);
      row.querySelector("input").checked = !this.hidden.has(label);
      row.querySelector("button").setAttribute("aria-pressed", String(this.isAlone(label)));
    }
    const { size } = this.hidden;
    if (!this.labels.length) this.words.textContent = "No parts yet.";
    else this.words.textContent = size ? `${size} of ${this.labels.length} hidden.` : "All parts are shown.";
  }
}
