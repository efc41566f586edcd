// List of scenes, the URL of the page, and the token.

import { call, token } from "./service.js";
import { NO_SCENE, noService } from "./states.js";
import { $, curtain, node, page } from "./page.js";

const LIST_EVERY_MS = 4000;

/** Scene and frame in the URL of the page. */
export const wanted = () => Object.fromEntries(new URLSearchParams(location.hash.slice(1)));

export function remember() {
  const words = new URLSearchParams({ scene: page.scene });
  if (page.frame !== null) words.set("frame", page.frame);
  history.replaceState(null, "", `#${words}`);
}

/** Removes the token of a share link from the URL, where others could see it. */
function takeToken() {
  const words = new URLSearchParams(location.hash.slice(1));
  if (!words.has("token")) return;
  token.set(words.get("token"));
  words.delete("token");
  history.replaceState(null, "", `${location.pathname}${words.size ? `#${words}` : ""}`);
}

const called = (scene) => (scene.name ? `${scene.name} (${scene.id.slice(0, 6)})` : scene.id);
const beside = (scene) => (scene.state === "failed" ? " · failed" : scene.archived ? " · archived" : scene.asleep ? " · asleep" : "");

export class SceneList {
  /** @param open opens a scene, given its status  @param listed called after each update of the list */
  constructor(open, listed) {
    Object.assign(this, { open, listed });
    takeToken();
    this.gone = false; // whether the open scene no longer exists; the message about it stays
    $("scenes").addEventListener("change", (event) => this.choose(event.target.value));
    setInterval(() => this.look(), LIST_EVERY_MS);
    document.addEventListener("visibilitychange", () => document.hidden || this.look());
  }

  /** Updates the list of scenes, and opens the requested one. */
  async look() {
    let scenes;
    try {
      scenes = (await call("GET", "/v1/scenes")).scenes;
    } catch (error) {
      if (error.status === 401 || error.status === 403) return this.askForToken(error.status === 401 && token.get());
      if (!page.stream) curtain(noService(error));
      return;
    }
    this.scenes = scenes;
    this.listed();
    const chosen = page.scene ?? wanted().scene;
    this.draw(scenes);
    const there = scenes.find((scene) => scene.id === chosen) ?? (this.gone || chosen ? null : scenes.at(-1));
    if (!there && !this.gone && !page.stream && chosen) this.missing(chosen);
    if (!there && scenes.length && $("scenes").options[0].value) {
      $("scenes").prepend(node("option", { value: "", disabled: true, selected: true }, "choose a scene"));
    }
    if (!there && scenes.length) $("scenes").value = "";
    if (there) $("scenes").value = there.id;
    if (!scenes.length && !page.stream && !this.gone && !chosen) curtain(NO_SCENE);
    if (there && there.id !== page.scene) this.choose(there.id);
  }

  draw(scenes) {
    const select = $("scenes");
    const words = scenes.map((scene) => called(scene) + beside(scene));
    select.disabled = scenes.length === 0;
    const there = [...select.options].filter((option) => option.value);
    if (there.map((option) => option.value).join() === scenes.map((scene) => scene.id).join()) { // the list may be open, so keep its options
      words.forEach((text, i) => (there[i].textContent = text));
      return;
    }
    select.replaceChildren(...scenes.map((scene, i) => node("option", { value: scene.id }, words[i])));
  }

  choose(id) {
    if (id === page.scene) return;
    this.gone = false;
    this.open(this.scenes.find((scene) => scene.id === id) ?? { id });
  }

  /** Name of a scene, or its id if it has no name or is not listed. */
  called(id) {
    const scene = (this.scenes ?? []).find((one) => one.id === id);
    return scene ? called(scene) : id;
  }

  /** Buttons for all scenes except one. */
  others(id) {
    return (this.scenes ?? []).filter((scene) => scene.id !== id).map((scene) => [scene.name || scene.id, () => this.choose(scene.id)]);
  }

  /** Reports that the scene in the URL does not exist. No other scene is opened instead, since it would be mistaken for it. */
  missing(id) {
    const actions = this.others(id);
    curtain({ title: "There is no such scene", words: `The service has no scene ${id}. ${actions.length ? "Choose one:" : "It has no scenes at all."}`, actions });
  }

  /** Shows no scene until one is chosen. */
  leave() {
    this.gone = true;
    history.replaceState(null, "", location.pathname);
  }

  /** Reports that the open scene no longer exists or may no longer be viewed. */
  async ended(id, reason, status) {
    this.leave();
    if (status === 401 || status === 403) this.askForToken(true);
    await this.look();
    const actions = this.others(id);
    curtain({ title: status === 404 ? "The scene is gone" : "Not allowed", words: `${reason} ${actions.length ? "Choose another one:" : ""}`, actions });
  }

  askForToken(again) {
    const door = $("door");
    if (door.open) return;
    if (again) $("door-words").textContent = `The ${token.reads() ? "link has expired" : "token is wrong"}. Enter the token that the service was started with (SCAS4D_TOKEN).`;
    token.forget();
    door.showModal();
    door.addEventListener("close", () => {
      token.set($("token").value.trim());
      $("token").value = "";
      this.gone = false;
      this.look();
    }, { once: true });
  }
}
