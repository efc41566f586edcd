// Files for other tools: requests exports from the service, shows their progress, and saves them.

import { $, node, page, sentence } from "../page.js";
import { call, fetched, scenePath, token } from "../service.js";

const LOOK_MS = 700;
const SELDOM_MS = 30_000; // maximum delay after errors, each of which doubles it
const UNDER_WAY = ["waiting", "running"];
const NAMES = {
  ply: "3DGS .ply", splat: ".splat", spz: "SPZ", spz4: "SPZ 4", glb: "glTF", "glb-parts": "glTF, moving parts",
  usd: "USD", tracks: "Tracks", poses: "Poses of parts", "tapvid-mv": "TAPVid-MV", s4d: "Compact 4D file",
};

const WITH_IDS = ["tracks", "tapvid-mv"]; // formats for which points can be selected

/** Formats a number of bytes, such as 3.1 MB. */
function size(bytes) {
  const step = bytes < 1e6 ? ["kB", 1e3] : bytes < 1e9 ? ["MB", 1e6] : ["GB", 1e9];
  const value = bytes / step[1];
  return `${value.toFixed(value < 10 ? 1 : 0)} ${step[0]}`;
}

const frames = (count) => (count === 1 ? "1 frame" : `${count} frames`);
const range = (one) => (one.first === one.last ? `frame ${one.first}` : `frames ${one.first} to ${one.last}`);

export class TakeAway {
  constructor() {
    Object.assign(this, { scene: null, timer: 0, wait: LOOK_MS, known: new Map() });
    $("take-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.begin();
    });
    $("take-format").addEventListener("change", () => this.choices());
  }

  open(id) {
    this.scene = id;
    this.say("");
    this.look();
  }

  close() {
    clearTimeout(this.timer);
    this.scene = null;
    this.known.clear();
    $("take-list").replaceChildren();
    for (const id of ["take-first", "take-last"]) $(id).value = "";
    $("take").hidden = true;
  }

  /** Updates which exports can be requested; called whenever the status changes. */
  show() {
    const committed = page.status?.committed > 0;
    $("take").hidden = token.reads() && !this.known.size;
    $("take-form").hidden = token.reads();
    $("take-make").disabled = !committed;
    for (const id of ["take-first", "take-last"]) $(id).max = page.status?.last_committed ?? 0;
    $("take-last").placeholder = committed ? page.status.last_committed : "last";
    this.choices();
  }

  choices() {
    const followed = page.tracks.some((track) => track.gaussian >= 0);
    $("take-followed-label").hidden = !WITH_IDS.includes($("take-format").value) || !followed;
  }

  async begin() {
    const body = { format: $("take-format").value };
    for (const [id, field] of [["take-first", "first"], ["take-last", "last"]]) {
      if ($(id).value !== "") body[field] = Number($(id).value);
    }
    if (!$("take-followed-label").hidden && $("take-followed").checked) {
      body.ids = [...new Set(page.tracks.filter((track) => track.gaussian >= 0).map((track) => track.gaussian))];
    }
    const { scene } = this;
    $("take-make").disabled = true;
    try {
      const made = await call("POST", `${scenePath(scene)}/exports`, body);
      if (this.scene === scene) this.say(`${NAMES[made.format]}, ${range(made)}: begun`);
    } catch (error) {
      if (this.scene === scene) this.say(error.message);
    }
    if (this.scene !== scene) return;
    this.show();
    this.look();
  }

  /** Requests the progress of the exports, periodically while one is unfinished. */
  async look() {
    clearTimeout(this.timer);
    const { scene } = this;
    let found = null;
    let refused = false;
    try {
      found = (await call("GET", `${scenePath(scene)}/exports`)).exports;
    } catch (error) { // the page reports elsewhere that the service does not respond
      refused = error.status >= 400 && error.status < 500 && error.status !== 429; // would be refused again
    }
    if (this.scene !== scene || scene === null) return;
    if (found) this.took(found);
    const busy = [...this.known.values()].some((one) => UNDER_WAY.includes(one.state));
    clearTimeout(this.timer);
    this.wait = found ? LOOK_MS : Math.min(SELDOM_MS, 2 * this.wait);
    if (!refused && (busy || !found)) this.timer = setTimeout(() => this.look(), this.wait);
  }

  took(found) {
    for (const one of found) {
      const before = this.known.get(one.id);
      if (!before || before.state === one.state) continue;
      if (one.state === "done") this.say(`${NAMES[one.format]}, ${range(one)}: done, ${size(one.bytes)}`);
      if (one.state === "failed") this.say(`${NAMES[one.format]}, ${range(one)}: failed`);
    }
    this.known = new Map(found.map((one) => [one.id, one]));
    const list = $("take-list");
    const here = new Map([...list.children].map((row) => [row.dataset.id, row]));
    for (const one of found) { // rows are kept, so that a focused button keeps the focus
      const said = JSON.stringify(one);
      const row = here.get(one.id) ?? list.appendChild(node("li", { "data-id": one.id }));
      here.delete(one.id);
      if (row.dataset.said === said) continue;
      if (row.dataset.state === one.state && UNDER_WAY.includes(one.state)) this.progress(row, one);
      else row.replaceChildren(...this.row(one));
      Object.assign(row.dataset, { said, state: one.state });
    }
    for (const row of here.values()) row.remove();
    this.show();
  }

  progress(row, one) {
    row.querySelector("progress").value = one.done / one.frames;
    row.querySelector("small").textContent = this.words(one);
  }

  words(one) {
    if (one.state === "waiting") return "waiting for its turn";
    if (one.state === "running") return `${one.done} of ${frames(one.frames)} · ${size(one.bytes)}`;
    if (one.state === "done") return `${frames(one.frames)} · ${size(one.bytes)} · until ${new Date(one.expires).toLocaleString([], { weekday: "short", hour: "2-digit", minute: "2-digit" })}`;
    return one.state === "failed" ? sentence(one.error) : "cancelled";
  }

  row(one) {
    const what = `${NAMES[one.format]}, ${range(one)}`;
    const busy = UNDER_WAY.includes(one.state);
    const parts = [node("span", { class: "what" }, what, node("br"), node("small", one.state === "failed" ? { class: "warning" } : {}, this.words(one)))];
    if (busy) parts.push(node("progress", { max: 1, value: one.done / one.frames, "aria-label": `Progress of ${what}` }));
    if (one.state === "done") parts.push(this.link(one, what));
    if (!token.reads()) {
      const verb = busy ? "Cancel" : "Remove";
      parts.push(node("button", { type: "button", "aria-label": `${verb} ${what}`, title: verb, onclick: () => this.remove(one) }, "×"));
    }
    return parts;
  }

  /** A plain link if no token is needed, since browsers do not send a token with a link; otherwise a button. */
  link(one, what) {
    const named = { "aria-label": `Save ${what}, ${size(one.bytes)}`, class: "save" };
    if (!token.get()) return node("a", { ...named, href: one.file, download: one.name }, "Save");
    return node("button", { ...named, type: "button", onclick: (event) => this.save(one, event.currentTarget) }, "Save");
  }

  async save(one, button) {
    button.disabled = true;
    let place = null;
    try {
      if (window.showSaveFilePicker) place = await (await showSaveFilePicker({ suggestedName: one.name })).createWritable();
      const answer = await fetched("GET", one.file);
      if (place) await answer.body.pipeTo(place);
      else {
        const link = node("a", { href: URL.createObjectURL(await answer.blob()), download: one.name });
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
      }
    } catch (error) {
      await place?.abort().catch(() => {}); // leaves no incomplete file
      if (error.name !== "AbortError") this.say(error.message); // otherwise, the user has cancelled
    }
    button.disabled = false;
  }

  async remove(one) {
    try {
      await call("DELETE", `${scenePath(this.scene)}/exports/${one.id}`);
      $("take-format").focus(); // the focused button is removed
    } catch (error) {
      this.say(error.message);
    }
    this.look();
  }

  say(words) {
    $("take-words").textContent = sentence(words);
  }
}
