// Tour of the page in four steps, which `scas4d demo` starts (`#scene=…&tour`). Once closed, it does not return.

import { $, node } from "../page.js";

const SEEN = "scas4d.tour";
const STEPS = [
  { at: "view", event: ["overlay", "pointermove"], title: "Look around",
    words: "Drag to turn the view, Shift-drag to pan, and use the wheel to zoom. The picture is rendered from 3D Gaussians, from any viewpoint." },
  { at: "time", event: ["time", "input"], title: "Move through time",
    words: "Drag the slider, or press the space bar to play. Every frame moves the same Gaussians." },
  { at: "view", event: ["overlay", "click"], title: "Follow a point",
    words: "Click a point of the object. The solid line shows its past, and the faint line its future." },
  { at: "modes", event: ["modes", "click"], title: "Show the parts",
    words: "Choose Parts. Gaussians that move together have the same colour. Nobody labelled them." },
];

export class Tour {
  constructor() {
    this.box = $("tour");
    this.step = 0;
    this.wanted = false; // whether the URL of the open scene asks for the tour
    $("tour-back").addEventListener("click", () => this.show(this.step - 1));
    $("tour-next").addEventListener("click", () => (this.step + 1 < STEPS.length ? this.show(this.step + 1) : this.close()));
    $("tour-close").addEventListener("click", () => this.close());
    STEPS.forEach(({ event: [id, name] }, step) => $(id).addEventListener(name, (event) => {
      if (!this.box.hidden && step === this.step && (name !== "pointermove" || event.buttons)) this.box.classList.add("done");
    }));
  }

  /** Starts the tour when the first picture is shown, if it is wanted and this browser has not closed it before. */
  start() {
    if (this.wanted && localStorage.getItem(SEEN) === null) this.show(0);
    this.wanted = false;
  }

  show(step) {
    const { at, title, words } = STEPS[step];
    this.step = step;
    this.mark(at);
    this.box.hidden = false;
    this.box.classList.remove("done");
    $("tour-title").replaceChildren(node("small", {}, `${step + 1} of ${STEPS.length}`), ` ${title}`);
    $("tour-words").textContent = words;
    $("tour-back").disabled = step === 0;
    $("tour-next").textContent = step + 1 < STEPS.length ? "Next" : "Done";
  }

  close() {
    localStorage.setItem(SEEN, "closed");
    this.box.hidden = true;
    this.mark(null);
  }

  /** Outlines the element that a step describes. */
  mark(id) {
    document.querySelector(".toured")?.classList.remove("toured");
    if (id) $(id).classList.add("toured");
  }
}
