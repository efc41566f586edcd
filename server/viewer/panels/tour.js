// Tour of the page in four steps, which `scas4d demo` starts (`#scene=…&tour`). Once closed, it does not return.

import { $, node } from "../page.js";

const SEEN = "scas4d.tour";
const STEPS = [
  { name: "orbit", element: "view", title: "Look around",
    text: "Drag to turn the view, Shift-drag to pan, and use the wheel to zoom. The picture is rendered from 3D Gaussians, from any viewpoint." },
  { name: "time", element: "time", title: "Move through time",
    text: "Drag the slider, or press the space bar to play. Every frame moves the same Gaussians." },
  { name: "point", element: "view", title: "Follow a point",
    text: "Click a point of the object. The solid line shows its past, and the faint line its future." },
  { name: "parts", element: "modes", title: "Show the parts",
    text: "Choose Parts. Gaussians that move together have the same colour; no labels were given." },
];

/** Whether this browser has closed the tour, or records that it has. Without storage, the tour starts on every visit. */
const closed = {
  get: () => { try { return localStorage.getItem(SEEN) !== null; } catch { return false; } },
  set: () => { try { localStorage.setItem(SEEN, "closed"); } catch { /* site data is blocked */ } },
};

export class Tour {
  constructor() {
    this.box = $("tour");
    this.step = 0;
    this.wanted = false; // whether the URL of the open scene asks for the tour
    $("tour-back").addEventListener("click", () => this.show(this.step - 1));
    $("tour-next").addEventListener("click", () => (this.step + 1 < STEPS.length ? this.show(this.step + 1) : this.close()));
    $("tour-close").addEventListener("click", () => this.close());
  }

  /** Starts the tour when the first picture is shown, if it is wanted and this browser has not closed it before. */
  start() {
    if (this.wanted && !closed.get()) this.show(0);
    this.wanted = false;
  }

  /** Marks a step as done if it is shown. */
  did(name) {
    if (!this.box.hidden && STEPS[this.step].name === name) this.box.classList.add("done");
  }

  show(step) {
    const { element, title, text } = STEPS[step];
    this.step = step;
    this.outline(element);
    this.box.hidden = false;
    this.box.classList.remove("done");
    $("tour-title").replaceChildren(node("small", {}, `${step + 1} of ${STEPS.length}`), ` ${title}`);
    $("tour-text").textContent = text;
    $("tour-back").disabled = step === 0;
    $("tour-next").textContent = step + 1 < STEPS.length ? "Next" : "Done";
  }

  hide() {
    this.box.hidden = true;
    this.outline(null);
  }

  close() {
    this.hide();
    closed.set();
  }

  /** Outlines the element that a step describes. */
  outline(id) {
    document.querySelector(".outlined")?.classList.remove("outlined");
    if (id) $(id).classList.add("outlined");
  }
}
