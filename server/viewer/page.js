// State shared by the modules of the page (the open scene and its frames), and the messages over the view.

const NOTE_MS = 6000;

export const $ = (id) => document.getElementById(id);

/** Creates an element; attributes that start with "on" are listeners, and null or false omits an attribute. */
export function node(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== null && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

/** Adds a capital letter and a full stop to a text. */
export const sentence = (text) => text && text[0].toUpperCase() + text.slice(1) + (/[.?!]$/.test(text) ? "" : ".");

/** Reports of finished frames, keyed by index; the list in order is made only after a change. */
class Reports extends Map {
  #ordered = null;
  #readable = null;

  set(index, report) {
    this.#ordered = this.#readable = null;
    return super.set(index, report);
  }

  clear() {
    this.#ordered = this.#readable = null;
    super.clear();
  }

  get ordered() {
    return (this.#ordered ??= [...this.values()].sort((a, b) => a.index - b.index));
  }

  get readable() {
    return (this.#readable ??= this.ordered.filter((report) => report.state === "committed" && !report.deleted));
  }
}

export const page = {
  scene: null, // id
  stream: null,
  status: null,
  rig: null,
  reports: new Reports(),
  frame: null, // index of the chosen frame; null follows the newest
  tracks: [],
  lost: false, // whether the connection is lost
  opened: 0, // number of times a scene was opened or closed; tells answers for a restarted reconstruction from earlier ones
};

/** Reports of all finished frames in order. */
export const inOrder = () => page.reports.ordered;

/** Reports of the frames that can be shown, in order. */
export const readable = () => page.reports.readable;

/**
 * Covers the view with a message.
 *
 * @param words { title, words, detail, share, actions }: share of the work that is done, [0, 1], null if unknown; actions [[label, run]]
 */
export function curtain({ title, words = "", detail = "", share, actions = [] }) {
  const box = $("curtain");
  box.hidden = false;
  const said = JSON.stringify([title, words, detail, actions.map(([label]) => label)]);
  const bar = box.querySelector("progress");
  bar.hidden = share === undefined;
  if (share === null) bar.removeAttribute("value");
  else if (share !== undefined) bar.value = share;
  if (box.dataset.said === said) return; // the status arrives several times a second; a focused button must keep the focus
  box.dataset.said = said;
  box.querySelector("h2").textContent = title;
  box.querySelector("p").textContent = words;
  box.querySelector(".detail").textContent = detail;
  box.querySelector(".choices").replaceChildren(...actions.map(([label, run]) =>
    node("button", { type: "button", class: "choice", onclick: run }, label)));
}

let fading = 0;

/** Shows a note at the top of the view; with the id of a failed subscription, it stays until that subscription succeeds. */
export function note(words, id = null) {
  page.failed = words ? id : null;
  clearTimeout(fading);
  if (words && !id) fading = setTimeout(() => note(""), NOTE_MS);
  $("note").textContent = sentence(words);
}
