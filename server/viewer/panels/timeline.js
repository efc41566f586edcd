// Timeline: the chosen frame, the slider with its marks, and playback at the recorded rate.

import { isRejected } from "./facts.js";
import { $, node, page, readable } from "../page.js";

const SHORTEST_MS = 20; // displays show no more pictures than this
const END_MS = 400; // how long the last frame is shown before playback restarts

export class Timeline {
  /**
   * @param shown called when another frame is chosen
   * @param stopped called when playback ends
   * @param between { smooth(index, next), set(next, share) }: returns whether moments between frames can be shown, and shows one
   */
  constructor(shown, stopped, between) {
    Object.assign(this, { shown, stopped, between, playing: null, speed: 1 });
    $("speed").addEventListener("change", () => {
      this.speed = Number($("speed").value);
      if (this.playing) this.from(readable().find((report) => report.index === page.frame) ?? readable()[0]);
    });
    $("time").addEventListener("input", (event) => {
      this.stop();
      this.choose(readable()[Number(event.target.value)]?.index ?? null);
    });
    $("play").addEventListener("click", () => this.play());
    $("back").addEventListener("click", () => this.step(-1));
    $("forth").addEventListener("click", () => this.step(1));
    $("live").addEventListener("click", () => this.live());
  }

  /** Chooses the frame nearest to an index; null follows the newest. */
  choose(index) {
    const frames = readable().map((report) => report.index);
    if (!frames.length) return;
    page.frame = index === null ? null : frames.reduce((best, one) => (Math.abs(one - index) < Math.abs(best - index) ? one : best));
    this.shown();
  }

  step(count) {
    this.stop();
    const frames = readable().map((report) => report.index);
    if (!frames.length) return;
    const at = page.frame === null ? frames.length - 1 : frames.indexOf(page.frame);
    this.choose(frames[Math.max(0, Math.min(frames.length - 1, at + count))]);
  }

  live() {
    this.stop();
    if (page.frame !== null) this.choose(null);
  }

  /** Plays from the current frame according to the frames' times; frames are skipped if pictures take longer. */
  play() {
    if (this.playing) return this.stop();
    const frames = readable();
    if (frames.length < 2) return;
    const at = frames.findIndex((report) => report.index === page.frame);
    this.from(frames[at < 0 || at === frames.length - 1 ? 0 : at]);
    $("play").textContent = "❚❚";
    $("play").setAttribute("aria-label", "Pause");
  }

  from(report) {
    clearTimeout(this.playing);
    const [began, time, { speed }] = [performance.now(), report.time, this];
    const turn = () => {
      const frames = readable();
      const now = time + speed * (performance.now() - began) / 1000;
      const at = Math.max(0, frames.findLastIndex((one) => one.time <= now));
      const [shown, next] = [frames[at], frames[at + 1]];
      if (shown.index !== page.frame) this.choose(shown.index);
      const smooth = next && this.between.smooth(shown.index, next.index);
      if (smooth) this.between.set(next.index, Math.min(1, (now - shown.time) / (next.time - shown.time)));
      const wait = next ? 1000 * (next.time - now) / speed : END_MS;
      this.playing = next ? setTimeout(turn, smooth ? SHORTEST_MS : Math.max(SHORTEST_MS, wait))
        : setTimeout(() => this.from(readable()[0]), END_MS);
    };
    turn();
  }

  stop() {
    clearTimeout(this.playing);
    const played = this.playing !== null;
    this.playing = null;
    if (played) this.stopped();
    $("play").textContent = "▶";
    $("play").setAttribute("aria-label", "Play");
  }

  /** Draws the slider, its marks and the text beside it, and returns the report of the current frame. */
  draw() {
    const reports = readable();
    const slider = $("time");
    slider.disabled = reports.length < 2;
    slider.max = Math.max(reports.length - 1, 0);
    const at = page.frame === null ? reports.length - 1 : reports.findIndex((report) => report.index === page.frame);
    slider.value = Math.max(at, 0);
    const report = reports[at];
    slider.setAttribute("aria-valuetext", report ? `frame ${report.index}` : "no frame");
    const how = isRejected(report) ? " · rejected" : report?.degraded ? " · in part" : "";
    $("moment").textContent = report ? `frame ${report.index} · ${report.time.toFixed(2)} s${how}` : "no frame";
    $("reason").hidden = !report?.degraded;
    $("reason").textContent = report?.degraded ? `Frame ${report.index}: ${report.degraded}.` : "";
    $("live").setAttribute("aria-pressed", String(page.frame === null));
    for (const id of ["play", "back", "forth", "live"]) $(id).disabled = reports.length < 2;
    this.mark(reports);
    return report;
  }

  /** Marks the frames on the slider whose state does not show their pictures. */
  mark(reports) {
    const said = JSON.stringify([reports.length, reports.filter((report) => report.degraded).map((report) => [report.index, report.degraded])]);
    if ($("marks").dataset.said === said) return; // a mark that is being pressed must stay
    $("marks").dataset.said = said;
    const last = Math.max(reports.length - 1, 1);
    $("marks").replaceChildren(...reports.flatMap((report, at) => {
      if (!report.degraded) return [];
      const mark = node("span", { title: `frame ${report.index}: ${report.degraded}`, onclick: () => this.choose(report.index) });
      mark.style.left = `${100 * at / last}%`;
      return [mark];
    }));
  }
}
