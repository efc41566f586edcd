// Dialog with the cluster's nodes, the resources that scenes reserve on each, and waiting processes. Hidden on a single machine.

import { $, node, sentence } from "../page.js";
import { call, token } from "../service.js";
import { counted } from "../states.js";

const LOOK_MS = 3000;
const STARTS_S = 5; // a process that has waited for less than this is about to start
const ROLES = { worker: "worker", views: "reader for views", bulk: "reader for tracks and parts", exporter: "export", replayer: "replay" };

const number = new Intl.NumberFormat("en", { maximumFractionDigits: 2 });
const gigabytes = (mb) => (mb / 1000).toFixed(1);

/** Formats a duration in seconds, such as 12 s, 3 min or 2 h. */
const since = (seconds) => (seconds < 90 ? `${Math.round(seconds)} s` : seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${Math.round(seconds / 3600)} h`);

export class ClusterView {
  /**
   * @param called returns the name of a scene, given its id
   * @param choose opens a scene, given its id
   */
  constructor(called, choose) {
    Object.assign(this, { called, choose, timer: 0, known: false });
    this.dialog = $("cluster");
    $("cluster-open").addEventListener("click", () => this.open());
    $("cluster-close").addEventListener("click", () => this.dialog.close());
    this.dialog.addEventListener("close", () => clearTimeout(this.timer));
  }

  /** Offers the dialog if scenes run on a cluster, which is requested only once; with a link to one scene, it stays hidden. */
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

  /** Updates the dialog periodically while it is open. */
  async look() {
    clearTimeout(this.timer);
    try {
      if (!document.hidden) this.show(await call("GET", "/v1/cluster"));
    } catch (error) {
      this.say(`${error.message} The list below is from its last response.`);
    }
    if (this.dialog.open) this.timer = setTimeout(() => this.look(), LOOK_MS);
  }

  show({ nodes, waiting, head_responds: headResponds }) {
    const alive = nodes.filter((one) => one.alive).length;
    const lost = nodes.length > alive ? `, ${nodes.length - alive} lost` : "";
    const late = waiting.filter((one) => one.seconds >= STARTS_S).length;
    const waits = late ? `${counted(late, "process is waiting", "processes are waiting")} for a node.` : "No process is waiting for a node.";
    const silent = headResponds ? "" : "The head of the cluster does not respond; the nodes are from its last response. ";
    this.say(`${silent}${counted(alive, "node")} alive${lost}. ${waits}`);
    const order = (one) => `${one.alive ? 1 : 0}${one.host}`;
    this.fill($("cluster-nodes"), [...nodes].sort((a, b) => order(a).localeCompare(order(b))), (one) => this.card(one));
    $("cluster-waiting").hidden = !waiting.length;
    this.fill($("cluster-waits"), waiting, (one) => this.waits(one));
  }

  /** Rebuilds a list if it has changed; a focused button in it keeps the focus. */
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
    const how = seconds < STARTS_S ? "is about to start." : `has been waiting for ${since(seconds)}. It needs ${needs}.`;
    return node("li", {}, this.button(scene), " ", node("span", {}, `The ${ROLES[role] ?? role} ${how}`));
  }

  button(scene) {
    return node("button", { type: "button", "data-scene": scene, title: "Open the scene", onclick: () => {
      this.dialog.close();
      this.choose(scene);
    } }, this.called(scene));
  }

  /** Sets the text only if it has changed, because a screen reader reads it out each time. */
  say(words) {
    const text = sentence(words);
    if ($("cluster-words").textContent !== text) $("cluster-words").textContent = text;
  }
}

/** Share of a resource, with its name, a bar and a text. */
function share(name, taken, all, words) {
  const bar = node("span", { class: "meter", "aria-hidden": "true" }, node("span"));
  bar.firstChild.style.width = `${Math.min(100, (100 * taken) / all)}%`;
  return node("p", { class: "share" }, node("span", {}, name), bar, node("span", {}, words));
}
