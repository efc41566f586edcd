// The dialog of the cluster: its nodes, what scenes take of each, and what waits for one. Not there on a single machine.

import { $, node, sentence } from "../page.js";
import { call, token } from "../service.js";
import { counted } from "../states.js";

const LOOK_MS = 3000;
const STARTS_S = 5; // a process that waits no longer is about to start
const ROLES = { worker: "worker", views: "reader of views", bulk: "reader of tracks and parts", exporter: "export", replayer: "replay" };

const number = new Intl.NumberFormat("en", { maximumFractionDigits: 2 });
const gigabytes = (mb) => (mb / 1000).toFixed(1);

/** Seconds for a person: 12 s, 3 min, 2 h. */
const since = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`);

export class ClusterView {
  /**
   * @param called the name of a scene, by its id
   * @param choose opens a scene, by its id
   */
  constructor(called, choose) {
    Object.assign(this, { called, choose, timer: 0, known: false });
    this.dialog = $("cluster");
    $("cluster-open").addEventListener("click", () => this.open());
    $("cluster-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("close", () => clearTimeout(this.timer));
  }

  /** Offers the dialog where scenes run on a cluster; asks for that once. A link to one scene shows nothing else. */
  async appear() {
    if (this.known || token.readsOne()) return;
    this.known = true;
    try {
      $("cluster-open").hidden = (await call("GET", "/v1/cluster")).placement === "local";
    } catch {
      this.known = false;
    }
  }

  open() {
    this.dialog.showModal();
    this.look();
  }

  /** Looks again and again while the dialog is open. */
  async look() {
    clearTimeout(this.timer);
    try {
      if (!document.hidden) this.show(await call("GET", "/v1/cluster"));
    } catch (error) {
      this.say(`${error.message} What is below was so when it last answered.`);
    }
    if (this.dialog.open) this.timer = setTimeout(() => this.look(), LOOK_MS);
  }

  show({ nodes, waiting, head_responds: headResponds }) {
    const alive = nodes.filter((one) => one.alive).length;
    const lost = nodes.length > alive ? `, ${nodes.length - alive} lost` : "";
    const late = waiting.filter((one) => one.seconds >= STARTS_S).length;
    const waits = late ? `${counted(late, "process waits", "processes wait")} for a node.` : "No process waits for a node.";
    const silent = headResponds ? "" : "The head of the cluster does not answer; the nodes are those of its last answer. ";
    this.say(`${silent}${counted(alive, "node")} alive${lost}. ${waits}`);
    const order = (one) => `${one.alive ? 1 : 0}${one.host}`;
    this.fill($("cluster-nodes"), [...nodes].sort((a, b) => order(a).localeCompare(order(b))), (one) => this.card(one));
    $("cluster-waiting").hidden = !waiting.length;
    this.fill($("cluster-waits"), waiting, (one) => this.waits(one));
  }

  /** Fills a list anew where it changed; a button of it that has the focus keeps it. */
  fill(list, content, item) {
    const said = JSON.stringify(content.map((one) => [one, this.called(one.scene ?? ""), ...(one.scenes ?? []).map(this.called)]));
    if (list.dataset.said === said) return;
    list.dataset.said = said;
    const focused = list.contains(document.activeElement) ? document.activeElement.dataset.scene : null;
    list.replaceChildren(...content.map(item));
    if (focused) (list.querySelector(`[data-scene="${CSS.escape(focused)}"]`) ?? $("cluster-close")).focus();
  }

  card({ id, host, labels, alive, cpus, cpus_reserved: cpusReserved, memory_mb: memory, memory_reserved_mb: memoryReserved, scenes }) {
    const words = Object.entries(labels).map(([name, value]) => `${name}=${value}`).join(" · ");
    const card = node("li", {}, node("h3", { title: id }, host, " ",
      node("span", { class: "chip", "data-state": alive ? "ready" : "failed" }, alive ? "alive" : "lost")));
    if (words) card.append(node("p", { class: "labels" }, words));
    if (!alive) return card;
    if (cpus) {
      card.append(share("CPUs", cpusReserved, cpus, `${number.format(cpusReserved)} of ${number.format(cpus)}`),
        share("Memory", memoryReserved, memory, `${gigabytes(memoryReserved)} of ${gigabytes(memory)} GB`));
    } else card.append(node("p", { class: "small" }, "No CPUs for scenes."));
    if (scenes.length) card.append(node("ul", { class: "row", "aria-label": `Scenes on ${host}` }, ...scenes.map((scene) => node("li", {}, this.button(scene)))));
    return card;
  }

  waits({ scene, role, needs, seconds }) {
    const how = seconds < STARTS_S ? "is about to start." : `has waited for ${since(seconds)}. It needs ${needs}.`;
    return node("li", {}, this.button(scene), " ", node("span", {}, `The ${ROLES[role] ?? role} ${how}`));
  }

  button(scene) {
    return node("button", { type: "button", "data-scene": scene, title: "Open the scene", onclick: () => {
      this.dialog.close();
      this.choose(scene);
    } }, this.called(scene));
  }

  /** Said anew only where it changed: a screen reader reads it out. */
  say(words) {
    const text = sentence(words);
    if ($("cluster-words").textContent !== text) $("cluster-words").textContent = text;
  }
}

/** A part of something: its name, a bar, and words. */
function share(name, taken, all, words) {
  const bar = node("span", { class: "meter", "aria-hidden": "true" }, node("span"));
  bar.firstChild.style.width = `${Math.min(100, (100 * taken) / all)}%`;
  return node("p", { class: "share" }, node("span", {}, name), bar, node("span", {}, words));
}
