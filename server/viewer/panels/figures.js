// Accuracy and time of the frames, as two charts with figures below them.

import { Chart } from "./charts.js";
import { reasonOf } from "./facts.js";
import { $, inOrder } from "../page.js";

const REDRAW_MS = 250; // frames may arrive 30 times per second

export class Figures {
  /** @param pick called with the index of a frame that is clicked */
  constructor(pick) {
    this.psnr = new Chart($("psnr"), "line", "dB", pick);
    this.seconds = new Chart($("seconds"), "bars", "s", pick);
    this.updates = []; // reports of all frames except the first
    this.drawnAt = -Infinity;
    this.timer = null;
  }

  choose(index) {
    this.psnr.choose(index);
    this.seconds.choose(index);
  }

  /** Draws the charts now, or soon if they have just been drawn. */
  draw() {
    const reports = inOrder();
    const first = reports.find((one) => one.state === "committed");
    this.updates = reports.filter((one) => one !== first);
    const wait = this.drawnAt + REDRAW_MS - performance.now();
    clearTimeout(this.timer);
    if (wait > 0) this.timer = setTimeout(() => this.draw(), wait);
    else this.drawNow(reports, first);
  }

  drawNow(reports, first) {
    this.drawnAt = performance.now();
    const fault = (one) => (one.state === "committed" ? "" : one.error ?? one.state);
    this.psnr.set(reports.map((one) => ({ index: one.index, value: one.psnr ?? null, fault: fault(one), rejected: reasonOf(one) })));
    const budgets = this.updates.filter((one) => one.budget);
    const changes = new Map(budgets.slice(1).map((one, i) => [one.index, change(budgets[i].budget, one.budget)]));
    // The first frame takes minutes and would flatten all others, so its time is written below the chart.
    this.seconds.set(reports.map((one) => ({ index: one.index, fault: fault(one), rejected: reasonOf(one), change: changes.get(one.index),
      value: one === first ? null : one.seconds?.total ?? null })));
    const times = this.updates.map((one) => one.seconds?.total).filter((value) => value !== undefined).sort((a, b) => a - b);
    $("figures").textContent = first
      ? `First frame ${(first.seconds?.total ?? 0).toFixed(1)} s` + (times.length ? `; updates: median ${times[times.length >> 1].toFixed(2)} s, at most ${times.at(-1).toFixed(2)} s` : "")
      : "";
  }
}

/** Description of a budget change since the previous frame. */
function change(before, now) {
  if (JSON.stringify(before) === JSON.stringify(now)) return "";
  if (now.keep_up_fps) return before.keep_up_fps === now.keep_up_fps ? "" : `keeping up with ${now.keep_up_fps} frames/s from here on`;
  if (now.budget_ms !== null) return `${now.budget_ms} ms from here on`;
  return now.iterations !== null ? `${now.iterations} iterations from here on` : "another budget from here on";
}
