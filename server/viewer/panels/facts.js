// Panels beside the view: facts, warnings, effects, queue, and the health of the cameras.

import { node, sentence } from "../page.js";

const number = new Intl.NumberFormat("en");

/** Reason why a committed state does not, or only partly, show the pictures of its frame; empty if it does. */
export function reasonOf(report) {
  if (!report?.degraded) return "";
  return report.degraded[0].toUpperCase() + report.degraded.slice(1);
}

const REJECTED = ["rejected_unusable", "rejected_implausible", "rejected_misfit"];

export const isRejected = (report) => REJECTED.includes(report?.outcome);

export function showFacts(list, status) {
  const facts = [
    ["Frames", `${number.format(status.committed)} committed`],
    ["Gaussians", status.gaussians === null ? "none yet" : number.format(status.gaussians)],
    ["Cameras", number.format(status.cameras.length)],
  ];
  for (const [key, words] of [["failed", "failed"], ["missing", "declared missing"], ["skipped", "skipped"]]) {
    if (status[key]) facts.push([words[0].toUpperCase() + words.slice(1), number.format(status[key])]);
  }
  if (status.worker_deaths) facts.push(["Worker restarts", number.format(status.worker_deaths)]);
  list.replaceChildren(...facts.flatMap(([name, value]) => [node("dt", {}, name), node("dd", {}, value)]));
}

const WARNINGS_SHOWN = 3;

/**
 * Lists the warnings of the scene, and shows their number on the button. They persist over all frames, or for as long as
 * cameras are out of step.
 * Alarms of a frame have another place and colour, because a warning does not mean that a frame is faulty.
 */
export function showWarnings(box, button, warnings) {
  const said = JSON.stringify(warnings);
  if (box.dataset.said === said) return; // the status arrives several times a second; nothing must be read out again, and the list must stay open
  box.dataset.said = said;
  box.hidden = button.hidden = !warnings.length;
  button.textContent = `${number.format(warnings.length)} to check`;
  const items = warnings.map((one) => node("li", {}, sentence(one)));
  const [first, rest] = box.querySelectorAll("ul");
  const more = box.querySelector("details");
  first.replaceChildren(...items.splice(0, WARNINGS_SHOWN));
  more.hidden = !items.length;
  more.open = false;
  more.querySelector("summary").textContent = `${number.format(items.length)} more`;
  rest.replaceChildren(...items);
}

const called = (name) => name[0].toUpperCase() + name.slice(1).replaceAll("_", " ");

/** Lists the effects that evidence or settings have switched; the text names all others, on or off. */
export function showEffects(list, words, effects) {
  const all = Object.entries(effects);
  const first = Math.min(...all.map(([, one]) => one.since));
  const listed = all.filter(([, one]) => one.pinned || one.text || one.since > first);
  list.replaceChildren(...listed.map(([name, one]) => {
    const state = one.pinned ? `pinned ${one.on ? "on" : "off"}` : `${one.on ? "on" : "off"} since frame ${one.since}`;
    return node("li", { title: one.description, class: one.on ? "on" : "off" }, `${called(name)}: ${state}${one.text ? `, ${one.text}` : ""}`);
  }));
  const rest = (on) => all.filter((one) => !listed.includes(one) && one[1].on === on).map(([name]) => called(name).toLowerCase());
  const [usual, idle] = [rest(true), rest(false)];
  words.textContent = [
    ...(usual.length ? [`In every update: ${usual.join(", ")}.`] : []),
    ...(idle.length ? [`Not needed here: ${idle.join(", ")}.`] : []),
  ].join(" ");
}

/** How far the reconstruction is behind the cameras, if that is more than a moment. */
const behind = (seconds) => (seconds >= 0.05 ? `, ${seconds.toFixed(1)} s behind the cameras` : "");

/** Draws a box for each place in the queue, and describes the queue in words. */
export function showQueue(box, words, status) {
  const places = Math.min(status.queue_limit, 24);
  const taken = Math.ceil(places * status.queued / status.queue_limit);
  box.replaceChildren(...Array.from({ length: places }, (_, i) => node("span", { class: i < taken ? "taken" : "free" })));
  const full = status.queued >= status.queue_limit;
  words.textContent = status.queued
    ? `${status.queued} of ${status.queue_limit} waiting or in progress${behind(status.behind_seconds)}${full ? "; the queue is full, so senders must wait" : ""}`
    : `Empty; frame ${status.next_frame} is next`;
  box.classList.toggle("full", full);
}

/**
 * Describes how long each stage of a live frame took, in milliseconds.
 *
 * @param times { published, drawn }: seconds from the commit to the sending of the state, and from its arrival to its picture
 */
export function showLatency(words, report, { frame, published, drawn }) {
  const { queue, update, commit } = report?.latency ?? {};
  const stages = [["queued", queue], ["decoded", report?.seconds?.decode], ["updated", update], ["committed", commit], ["sent", published], ["drawn", drawn]];
  const known = stages.filter(([, seconds]) => seconds != null).map(([name, seconds]) => `${name} ${Math.round(1000 * seconds)}`);
  words.textContent = `Frame ${frame}, in ms: ${known.join(", ")}`;
}

/** Time offset of a camera if it is clearly out of step, which is a lasting fault that the scene's warnings also report. */
const outOfStep = (one) => (one?.out_of_step ? `, which takes its pictures ${Math.abs(one.frames).toFixed(2)} frames ${one.frames > 0 ? "after" : "before"} the others` : "");

/** Evidence of the alarms about a camera, which the worker raised when it reconstructed the frame. */
export const complaints = (name, report) => (report?.alarms ?? []).filter((one) => one.camera === name).map((one) => one.evidence);

const IN_THE_REASON = ["frame_rejected", "frame_in_part"];

/** Alarms as sentences, except for those that the reason of the frame already states. */
function sentences(report) {
  return (report?.alarms ?? []).filter((one) => !IN_THE_REASON.includes(one.kind)).map((one) => {
    const words = one.camera === null ? called(one.evidence) : `Camera ${one.camera}: ${one.evidence}`;
    return words.endsWith("?") ? words : `${words}.`;
  });
}

/** Fills a row for each camera: PSNR of its picture, colour shift, and faults. */
export function showCameras(body, summary, names, report, lookFrom) {
  const said = JSON.stringify([names, report?.index, report?.cameras, report?.alarms]);
  if (body.dataset.said === said) return; // a focused row must keep the focus
  body.dataset.said = said;
  const fits = report?.cameras ?? {};
  const known = Object.values(fits).map((fit) => fit.psnr).filter((value) => value !== null);
  const [low, high] = [Math.min(...known, 20), Math.max(...known, 40)];
  const rows = names.map((name, index) => {
    const fit = fits[name];
    const found = complaints(name, report);
    const meter = node("span", { class: "meter" }, node("span", {}));
    const share = fit && fit.psnr !== null ? Math.max(0.03, (fit.psnr - low) / (high - low)) : 0;
    meter.firstChild.style.width = `${100 * share}%`;
    const shift = fit?.colour_shift;
    const swatch = node("span", { class: "swatch", title: shift ? `red, green, blue: ${shift.map((v) => `${(100 * v).toFixed(1)}%`).join(", ")}` : "not measured" });
    // Shown around middle grey and ten times amplified, so that a shift of one hundredth is visible.
    if (shift) swatch.style.background = `rgb(${shift.map((v) => Math.round(128 + 1280 * v)).join(" ")})`;
    const words = found.length ? found.join("; ") : "";
    return node("tr", { class: found.length ? "bad" : null },
      node("th", { scope: "row" }, node("button", { type: "button", class: "link", title: `Look through camera ${name}${outOfStep(report?.timing?.[name])}`, onclick: () => lookFrom(index) }, name)),
      node("td", {}, meter),
      node("td", { class: "figure" }, fit && fit.psnr !== null ? fit.psnr.toFixed(1) : "–"),
      node("td", {}, swatch),
      node("td", { class: "figure" }, shift ? `${(100 * Math.max(...shift.map(Math.abs))).toFixed(1)}%` : "–"),
      node("td", { class: "words", title: words },
        (found.length ? "⚠ " : "") + (name in (report?.dropped_cameras ?? {}) ? "left out" : fit?.health != null ? `${Math.round(100 * fit.health)}%`
          : found.length ? "check" : fit ? "good" : "no data")));
  });
  body.replaceChildren(...rows);
  const lines = sentences(report);
  summary.textContent = lines.length ? lines.slice(0, 3).join(" ") + (lines.length > 3 ? ` … and ${lines.length - 3} more.` : "")
    : !report || !known.length ? "Available after the first update."
    : `All ${names.length} cameras look as before.`;
  summary.classList.toggle("warning", lines.length > 0);
}
