// What the modules of the page share: the scene that is open, its frames, and the places for words over the view.

const NOTE_MS = 6000;

export const $ = (id) => document.getElementById(id);

/** Makes an element; attributes that begin with "on" are listeners, null and false leave one out. */
export function node(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value !== null && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children);
  return made;
}

/** A text with a capital letter and a full stop. */
export const sentence = (text) => text && text[0].toUpperCase() + text.slice(1) + (/[.?!]$/.test(text) ? "" : ".");

export const page = {
  scene: null, // id
  stream: null,
  status: null,
  rig: null,
  reports: new Map(), // of finished frames, by index
  frame: null, // chosen; null follows the newest
  tracks: [],
  lost: false, // the connection
  opened: 0, // times that a scene was opened or closed; one that begins anew is the same scene, and its answers are others
};

export const inOrder = () => [...page.reports.values()].sort((a, b) => a.index - b.index);
export const readable = () => inOrder().filter((report) => report.state === "committed" && !report.deleted);

/**
 * Covers the view with words.
 *
 * @param words { title, words, detail, share, actions }: share of the work, 0…1, null where it is not known; actions [[label, run]]
 */
export function curtain({ title, words = "", detail = "", share, actions = [] }) {
  const box = $("curtain");
  box.hidden = false;
  const said = JSON.stringify([title, words, detail, actions.map(([label]) => label)]);
  const bar = box.querySelector("progress");
  bar.hidden = share === undefined;
  if (share === null) bar.removeAttribute("value");
  else if (share !== undefined) bar.value = share;
  if (box.dataset.said === said) return; // status comes several times a second: what has the focus keeps it
  box.dataset.said = said;
  box.querySelector("h2").textContent = title;
  box.querySelector("p").textContent = words;
  box.querySelector(".detail").textContent = detail;
  box.querySelector(".choices").replaceChildren(...actions.map(([label, run]) =>
    node("button", { type: "button", class: "choice", onclick: run }, label)));
}

let fading = 0;

/** Says something at the top of the view; with the id of what failed it stays until that goes well. */
export function note(words, id = null) {
  page.failed = words ? id : null;
  clearTimeout(fading);
  if (words && !id) fading = setTimeout(() => note(""), NOTE_MS);
  $("note").textContent = sentence(words);
}
