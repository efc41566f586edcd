// Dialog to manage a scene: its name and retention, pausing, archiving, sleep, restart of its reconstruction, and deletion.

import { call, scenePath } from "./service.js";
import { $, note, page, sentence } from "./page.js";

export class Manage {
  /**
   * @param changed called with the status after a change
   * @param letGo closes the scene and puts it to sleep
   */
  constructor(changed, letGo) {
    this.dialog = $("manage");
    Object.assign(this, { changed, letGo });
    $("manage-open").addEventListener("click", () => this.open());
    $("manage-close").addEventListener("click", () => this.dialog.close());
    $("manage-save").addEventListener("click", () => this.save());
    $("manage-pause").addEventListener("click", () => this.post(page.status.paused ? "resume" : "pause"));
    $("manage-archive").addEventListener("click", () => this.edit({ archived: !page.status.archived }, page.status.archived ? "restored" : "archived"));
    $("manage-sleep").addEventListener("click", () => this.sleep());
    $("manage-again").addEventListener("click", () => this.sure($("manage-again"), "Discard all frames and begin again", () => this.again()));
    $("manage-delete").addEventListener("click", () => this.sure($("manage-delete"), "Delete for good", () => this.remove()));
    this.dialog.addEventListener("close", () => this.unsure());
  }

  open() {
    if (!page.status) return;
    $("manage-words").textContent = "";
    $("manage-name").value = page.status.name;
    const kept = (rule) => rule?.last ?? "";
    $("manage-frames").value = kept(page.status.ingest.keep_frames);
    $("manage-states").value = kept(page.status.ingest.keep_states);
    this.show();
    this.dialog.showModal();
  }

  /** Updates the available actions; called whenever the status changes. */
  show() {
    const status = page.status;
    if (!status) return this.dialog.open && this.dialog.close();
    $("manage-title").textContent = status.name || status.id;
    $("manage-id").textContent = status.id;
    $("manage-pause").textContent = status.paused ? "Resume" : "Pause";
    $("manage-pause").disabled = status.state === "failed";
    $("manage-archive").textContent = status.archived ? "Restore" : "Archive";
    $("manage-sleep").disabled = status.asleep;
    $("manage-again").disabled = status.archived || status.next_frame === 0;
  }

  async save() {
    const edit = {};
    const name = $("manage-name").value.trim();
    if (name !== page.status.name) edit.name = name;
    for (const [id, field] of [["manage-frames", "keep_frames"], ["manage-states", "keep_states"]]) {
      const given = $(id).value === "" ? null : Number($(id).value);
      const { last, seconds } = page.status.ingest[field] ?? {};
      if (given !== (last ?? null)) edit[field] = { ...(given !== null && { last: given }), ...(seconds && { seconds }) };
    }
    if (Object.keys(edit).length) await this.edit(edit, "saved");
    else this.say("no changes");
  }

  edit(edit, done) {
    return this.run(() => call("PATCH", scenePath(page.scene), edit), done);
  }

  post(verb) {
    return this.run(() => call("POST", `${scenePath(page.scene)}/${verb}`), { pause: "paused", resume: "resumed" }[verb]);
  }

  again() {
    const body = { discard: true };
    return this.run(() => call("PUT", `${scenePath(page.scene)}/reconstructions/${page.status.reconstruction + 1}`, body), "restarted");
  }

  async remove() {
    if (await this.run(() => call("DELETE", scenePath(page.scene)), "deleted")) this.dialog.close();
  }

  /** Closes the scene first, because the page itself keeps it awake. */
  sleep() {
    this.dialog.close();
    this.letGo();
  }

  async run(act, done) {
    this.unsure();
    try {
      const status = await act();
      if (status?.id === page.scene) this.changed(status);
      this.say(done);
      return true;
    } catch (error) {
      this.say(error.message);
      return false;
    } finally {
      this.show();
    }
  }

  say(words) {
    if (this.dialog.open) $("manage-words").textContent = sentence(words);
    else if (words) note(words);
  }

  /** Asks for confirmation on the first press and acts on the second. */
  sure(button, words, act) {
    if (button.dataset.sure) return act();
    this.unsure();
    button.dataset.sure = button.textContent;
    button.textContent = words;
  }

  unsure() {
    for (const button of this.dialog.querySelectorAll("[data-sure]")) {
      button.textContent = button.dataset.sure;
      delete button.dataset.sure;
    }
  }
}
