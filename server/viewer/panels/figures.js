// Accuracy and time of the frames, as two charts with figures below them.

import { Chart } from "./charts.js";
import { reasonOf } from "./facts.js";
import { $, inOrder } from "../page.js";

export class Figures {
  /** @param pick called with the index of a frame that is clicked */
  constructor(pick) {
    this.psnr = new Chart($("psnr"), "line", "dB", pick);
    this.seconds = new Chart($("seconds"), "bars", "s", pick);
    this.updates = []; // reports of all frames except the first
  }

  choose(index) {
    this.psnr.choose(index);
    this.seconds.choose(index);
  }

  draw() {
    const reports = inOrder();
    const fault = (one) => (one.state === "committed" ? "" : one.error ?? one.state);
    this.psnr.set(reports.map((one) => ({ index: one.index, value: one.psnr ?? null, fault: fault(one), rejected: reasonOf(one) })));
    // The first frame takes minutes and would flatten all others, so its time is written below the chart.
    const first = reports.find((one) => one.state === "committed");
    this.updates = reports.filter((one) => one !== first);
    const budgets = this.updates.filter((one) => one.budget);
    const changes = new Map(budgets.slice(1).map((one, i) => [one.index, change(budgets[i].budget, one.budget)]));
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
