// The page: chooses a scene and a frame, and shows them.

import { Chart } from "./charts.js";
import { TRACKS } from "./colours.js";
import { isHeld, node, reasonOf, showCameras, showEffects, showFacts, showQueue, showWarnings, stateWords } from "./panels.js";
import { call, scenePath, token } from "./service.js";
import { Stream } from "./stream.js";
import { Tradeoff } from "./tradeoff.js";
import { LiveView } from "./view.js";

const LIST_EVERY_MS = 4000;
const PLAY_FPS = 8;
const MOST_TRACKS = 12;
const PICK_PX = 320;
const NOTE_MS = 6000;
const $ = (id) => document.getElementById(id);

const page = {
  stream: null,
  status: null,
  rig: null,
  reports: new Map(), // of finished frames, by index
  frame: null, // chosen; null follows the newest
  tracks: [],
  picks: 0,
  playing: null,
  opened: 0, // times that a scene was opened or closed; one that begins anew is the same scene, and its answers are others
};

const view = new LiveView($("picture"), $("overlay"), {
  pick,
  shown: showInfo,
  slow: (mode) => {
    const ready = page.status?.committed > 0;
    $("busy").hidden = !ready || page.lost;
    $("busy").textContent = mode === "parts" ? "Finding the parts …" : "Waiting for the picture …";
  },
  turned: () => $("hint").classList.add("known"),
});
const psnr = new Chart($("psnr"), "line", "dB", choose);
const seconds = new Chart($("seconds"), "bars", "s", choose);
const tradeoff = new Tradeoff($);

// Scenes.

async function listScenes() {
  let scenes;
  try {
    scenes = (await call("GET", "/v1/scenes")).scenes;
  } catch (error) {
    if (error.status === 401 || error.status === 403) return askForToken(error.status === 401 && token.get());
    if (!page.stream) curtain(error.status === 503 ? "The service is starting" : "No connection", error.message);
    return;
  }
  const select = $("scenes");
  const chosen = page.scene ?? wanted().scene;
  select.replaceChildren(...scenes.map((scene) =>
    node("option", { value: scene.id }, scene.name ? `${scene.name} (${scene.id.slice(0, 6)})` : scene.id)));
  select.disabled = scenes.length === 0;
  const there = scenes.find((scene) => scene.id === chosen) ?? (page.gone || chosen ? null : scenes.at(-1));
  if (!there && !page.gone && !page.stream && chosen) missing(chosen, scenes);
  if (!there && scenes.length) select.prepend(node("option", { value: "", disabled: true, selected: true }, "choose a scene"));
  if (there) select.value = there.id;
  if (!scenes.length && !page.stream && !page.gone && !chosen) {
    curtain("No scene yet", "Send a capture and it appears here:", "scas4d push samples/robot --fps 5");
  }
  if (there && there.id !== page.scene) openScene(there.id);
}

/** The address names a scene that is not here. No other scene is opened in its place: it would be taken for it. */
function missing(id, scenes) {
  const box = curtain("There is no such scene", `The service has no scene ${id}. ${scenes.length ? "Choose one:" : "It has no others either."}`);
  box.querySelector(".detail").replaceChildren(...scenes.map((scene) =>
    node("button", { type: "button", class: "choice", onclick: () => openScene(scene.id) }, scene.name || scene.id)));
}

const wanted = () => Object.fromEntries(new URLSearchParams(location.hash.slice(1)));

async function openScene(id) {
  closeScene();
  page.scene = id;
  page.gone = false;
  const hash = wanted();
  page.frame = hash.scene === id && hash.frame ? Number(hash.frame) : null;
  const opened = page.opened;
  remember();
  curtain("Opening the scene", "");
  let rig;
  try {
    rig = await call("GET", `${scenePath(id)}/rig`);
  } catch (error) {
    if (page.opened !== opened) return;
    page.scene = null;
    curtain("The scene cannot be opened", error.message);
    return;
  }
  if (page.opened !== opened) return;
  page.rig = rig;
  $("from").replaceChildren(...rig.cameras.map((camera, index) => node("option", { value: index }, camera.name)));
  page.stream = new Stream(id, {
    state: connection,
    scene: (message) => showStatus(message.status),
    frame: (message) => finished(message.report, message.missed),
    bulk,
    error: failed,
    gone,
  });
  page.stream.subscribe("scene", "scene");
  page.stream.subscribe("frames", "frames");
  view.open(page.stream, rig);
  view.setFrame(page.frame);
  tradeoff.open(id);
  await loadReports();
}

function closeScene() {
  page.opened++;
  page.stream?.close();
  view.close();
  tradeoff.close();
  stopPlaying();
  Object.assign(page, { stream: null, status: null, rig: null, scene: null, tracks: [], failed: null });
  page.reports.clear();
  showTracks();
  redraw();
  $("state").hidden = $("trouble").hidden = true;
  $("facts").replaceChildren();
  showWarnings($("warnings"), $("to-check"), []);
  $("queue").replaceChildren();
  $("queue-words").textContent = $("note").textContent = "";
  $("cameras").replaceChildren();
}

function gone(reason, status) {
  closeScene();
  page.gone = true;
  history.replaceState(null, "", location.pathname);
  $("connection").textContent = "Not connected";
  $("banner").hidden = true;
  curtain(status === 404 ? "The scene is gone" : "Not allowed", `${reason} Choose another one above.`);
  if (status === 401 || status === 403) askForToken(true);
  listScenes();
}

function connection(state, wait) {
  const live = state === "live";
  $("connection").textContent = live ? "Connected" : "Reconnecting";
  $("connection").classList.toggle("good", live);
  $("banner").hidden = live;
  if (live) {
    if (page.lost) loadReports(), tradeoff.refresh();
    page.lost = false;
  } else {
    page.lost = true;
    $("banner").textContent = `The connection to the service is lost. The next try is in ${wait < 1 ? "a moment" : `${Math.round(wait)} s`}; the page shows the last data that came.`;
  }
}

// State and frames.

function showStatus(status) {
  if (page.status && status.reconstruction !== page.status.reconstruction) return openScene(status.id); // begun anew
  page.status = status;
  const chip = $("state");
  chip.hidden = false;
  chip.textContent = stateWords(status);
  chip.dataset.state = status.state === "failed" ? "failed" : status.degraded ? "degraded" : status.state;
  $("trouble").hidden = !status.error;
  $("trouble").textContent = status.error ? status.error[0].toUpperCase() + status.error.slice(1) + "." : "";
  showFacts($("facts"), status);
  showQueue($("queue"), $("queue-words"), status);
  showWarnings($("warnings"), $("to-check"), status.warnings);
  showEffects($("effects"), $("effects-words"), status.effects);
  if (!status.committed) {
    const progress = status.progress;
    if (status.state === "failed") curtain("The scene has failed", $("trouble").textContent);
    else if (progress) {
      const { loss, seconds_left: left, seconds_at_most: most } = progress.detail ?? {};
      const when = left !== undefined ? ` · about ${Math.ceil(left)} s left` : most ? ` · ${Math.ceil(most)} s at most` : "";
      curtain("Reconstructing the first frame", `${progress.stage[0].toUpperCase()}${progress.stage.slice(1)}`,
        `${progress.done} of ${progress.total}${loss === undefined ? "" : ` · loss ${loss.toFixed(4)}`}${when}`,
        progress.total ? progress.done / progress.total : null);
    } else if (status.state === "initialising") curtain("Reconstructing the first frame", "The pictures are being read");
    else curtain("Waiting for the first frame", "The scene accepts frames.", `PUT ${scenePath(status.id)}/frames/${status.next_frame}`);
  }
  if (status.committed && !view.shown) curtain("Opening the scene", "The first picture is on its way.");
  showTimeline();
}

async function loadReports() {
  const { scene: id, opened } = page;
  try {
    for (let from = 0; ;) {
      const { frames, next } = await call("GET", `${scenePath(id)}/frames?first=${from}`);
      if (page.opened !== opened) return;
      for (const report of frames) keep(report);
      if (next === null) break;
      from = next;
    }
  } catch (error) {
    if (page.opened !== opened) return;
    note(error.message);
  }
  redraw();
}

function keep(report) {
  if (["committed", "set_aside", "missing", "skipped"].includes(report.state)) page.reports.set(report.index, report);
}

function finished(report, missed) {
  keep(report);
  if (missed) loadReports();
  else redraw();
  tradeoff.refresh();
}

const inOrder = () => [...page.reports.values()].sort((a, b) => a.index - b.index);
const readable = () => inOrder().filter((report) => report.state === "committed" && !report.deleted);

function redraw() {
  const reports = inOrder();
  const fault = (one) => (one.state === "committed" ? "" : one.error ?? one.state);
  psnr.set(reports.map((one) => ({ index: one.index, value: one.psnr ?? null, fault: fault(one), held: reasonOf(one) })));
  // The first frame takes minutes and would flatten all others; it is written below the chart.
  const first = reports.find((one) => one.state === "committed");
  const updates = reports.filter((one) => one !== first);
  const budgets = updates.filter((one) => one.budget);
  const changes = new Map(budgets.slice(1).map((one, i) => [one.index, change(budgets[i].budget, one.budget)]));
  tradeoff.follow(updates);
  seconds.set(reports.map((one) => ({ index: one.index, fault: fault(one), held: reasonOf(one), change: changes.get(one.index),
    value: one === first ? null : one.seconds?.total ?? null })));
  const times = updates.map((one) => one.seconds?.total).filter((value) => value !== undefined).sort((a, b) => a - b);
  $("figures").textContent = first
    ? `First frame ${(first.seconds?.total ?? 0).toFixed(1)} s` + (times.length ? `; updates ${times[times.length >> 1].toFixed(2)} s in the median, ${times.at(-1).toFixed(2)} s at most` : "")
    : "";
  showTimeline();
  showHealth();
}

/** A change of budget since the frame before, in words. */
function change(before, now) {
  if (JSON.stringify(before) === JSON.stringify(now)) return "";
  if (now.budget_ms !== null) return `from here on ${now.budget_ms} ms`;
  return now.iterations !== null ? `from here on ${now.iterations} iterations` : "from here on another budget";
}

// Time.

function choose(index) {
  const frames = readable().map((report) => report.index);
  if (!frames.length) return;
  page.frame = index === null ? null : frames.reduce((best, one) => (Math.abs(one - index) < Math.abs(best - index) ? one : best));
  remember();
  view.setFrame(page.frame);
  showTimeline();
  showHealth();
}

function stepBy(count) {
  const frames = readable().map((report) => report.index);
  if (!frames.length) return;
  const at = page.frame === null ? frames.length - 1 : frames.indexOf(page.frame);
  choose(frames[Math.max(0, Math.min(frames.length - 1, at + count))]);
}

function showTimeline() {
  const reports = readable();
  const slider = $("time");
  slider.disabled = reports.length < 2;
  slider.max = Math.max(reports.length - 1, 0);
  const at = page.frame === null ? reports.length - 1 : reports.findIndex((report) => report.index === page.frame);
  slider.value = Math.max(at, 0);
  const report = reports[at];
  slider.setAttribute("aria-valuetext", report ? `frame ${report.index}` : "no frame");
  const how = isHeld(report) ? " · held" : report?.degraded ? " · in part" : "";
  $("moment").textContent = report ? `frame ${report.index} · ${report.time.toFixed(2)} s${how}` : "no frame";
  $("reason").hidden = !report?.degraded;
  $("reason").textContent = report?.degraded ? `Frame ${report.index}: ${report.degraded}.` : "";
  showMarks(reports);
  $("live").setAttribute("aria-pressed", String(page.frame === null));
  for (const id of ["play", "back", "forth"]) $(id).disabled = reports.length < 2;
  psnr.choose(report?.index ?? null);
  seconds.choose(report?.index ?? null);
}

/** Marks frames on the slider whose state is not what their pictures show. */
function showMarks(reports) {
  const last = Math.max(reports.length - 1, 1);
  $("marks").replaceChildren(...reports.flatMap((report, at) => {
    if (!report.degraded) return [];
    const mark = node("span", { title: `frame ${report.index}: ${report.degraded}`, onclick: () => choose(report.index) });
    mark.style.left = `${100 * at / last}%`;
    return [mark];
  }));
}

function showHealth() {
  if (!page.rig) return;
  const reports = inOrder().filter((one) => one.state === "committed");
  const index = page.frame ?? reports.at(-1)?.index;
  const measured = reports.filter((one) => Object.keys(one.cameras ?? {}).length && one.index <= index);
  showCameras($("cameras"), $("camera-summary"), page.rig.cameras.map((camera) => camera.name), measured.at(-1), lookFrom);
}

function play() {
  if (page.playing) return stopPlaying();
  const frames = () => readable().map((report) => report.index);
  page.playing = setInterval(() => {
    const all = frames();
    const at = all.indexOf(page.frame);
    choose(all[(at + 1) % all.length]);
  }, 1000 / PLAY_FPS);
  $("play").textContent = "❚❚";
  $("play").setAttribute("aria-label", "Pause");
}

function stopPlaying() {
  clearInterval(page.playing);
  page.playing = null;
  $("play").textContent = "▶";
  $("play").setAttribute("aria-label", "Play");
}

function remember() {
  const words = new URLSearchParams({ scene: page.scene });
  if (page.frame !== null) words.set("frame", page.frame);
  history.replaceState(null, "", `#${words}`);
}

// The picture.

function bulk(head, bytes) {
  if (head.type === "render") view.receive(head, bytes).catch((error) => note(`The picture could not be shown: ${error.message}`));
  else if (head.type === "tracks") grow(head, JSON.parse(new TextDecoder().decode(bytes)));
}

function showInfo(info) {
  $("curtain").hidden = true;
  if (info.tag === view.tag) $("busy").hidden = true;
  if (page.failed === "view") note("");
  const legend = $("legend");
  legend.hidden = info.mode !== "depth";
  if (!legend.hidden) {
    $("near").textContent = info.near.toPrecision(3);
    $("far").textContent = info.far.toPrecision(3);
  }
  const stage = $("view").dataset;
  Object.assign(stage, { frame: info.frame, mode: info.mode, tag: info.tag, size: `${info.width}x${info.height}` });
}

function setMode(mode) {
  for (const button of $("modes").children) button.setAttribute("aria-checked", String(button.dataset.mode === mode));
  for (const button of $("modes").children) button.tabIndex = button.dataset.mode === mode ? 0 : -1;
  $("part-count").hidden = mode !== "parts";
  view.setMode(mode);
}

function lookFrom(index) {
  $("from").value = index;
  view.lookFrom(index);
}

function curtain(title, words, detail = "", share) {
  const box = $("curtain");
  box.hidden = false;
  box.querySelector("h2").textContent = title;
  box.querySelector("p").textContent = words;
  box.querySelector(".detail").textContent = detail;
  const bar = box.querySelector("progress");
  bar.hidden = share === undefined;
  if (share === null) bar.removeAttribute("value");
  else if (share !== undefined) bar.value = share;
  return box;
}

function note(words, id = null) {
  page.failed = words ? id : null;
  clearTimeout(page.fading);
  if (words && !id) page.fading = setTimeout(() => note(""), NOTE_MS);
  $("note").textContent = words ? words[0].toUpperCase() + words.slice(1) + (words.endsWith(".") ? "" : ".") : "";
}

// Tracks.

function failed(message) {
  const track = page.tracks.find((one) => one.id === message.id);
  if (track && !track.positions.size) forget(track);
  note(message.problem.detail, track ? null : message.id);
}

/** The same view in a smaller picture: visibility is computed from depth pictures of this size. */
function smaller(camera) {
  const ratio = Math.min(1, PICK_PX / Math.max(camera.width, camera.height));
  const [width, height] = [Math.round(camera.width * ratio), Math.round(camera.height * ratio)];
  const [sx, sy] = [width / camera.width, height / camera.height];
  const k = camera.intrinsics;
  const intrinsics = [[k[0][0] * sx, 0, k[0][2] * sx], [0, k[1][1] * sy, k[1][2] * sy], k[2]];
  return { camera: { ...camera, width, height, intrinsics }, sx, sy };
}

function pick(u, v, camera, frame) {
  if (!page.stream) return;
  if (page.tracks.length >= MOST_TRACKS) forget(page.tracks[0]);
  const id = `track-${++page.picks}`;
  const used = new Set(page.tracks.map((track) => track.colour));
  const colour = TRACKS.find((one) => !used.has(one)) ?? TRACKS[page.picks % TRACKS.length];
  page.tracks.push({ id, colour, name: page.picks, positions: new Map(), confidence: new Map() });
  const small = smaller(camera);
  page.stream.subscribe(id, "tracks", { pixels: [[u * small.sx, v * small.sy]], camera: small.camera, at: frame }, page.picks);
  showTracks();
}

function grow(head, model) {
  const track = page.tracks.find((one) => one.id === head.id);
  if (!track) return;
  if (model.ids[0] < 0) {
    forget(track);
    note("There is no surface at that point: click one of the objects");
    return;
  }
  if (page.failed === null) note("");
  track.gaussian = model.ids[0];
  model.frames.forEach((frame, k) => {
    track.positions.set(frame, model.positions[0][k]);
    track.confidence.set(frame, model.confidence[0][k]);
  });
  view.draw();
  showTracks();
}

function forget(track) {
  page.stream?.unsubscribe(track.id);
  page.tracks = page.tracks.filter((one) => one !== track);
  showTracks();
}

function showTracks() {
  view.tracks = page.tracks;
  $("track-hint").hidden = page.tracks.length > 0;
  $("clear").hidden = page.tracks.length < 2;
  $("tracks").replaceChildren(...page.tracks.map((track) => {
    const key = node("span", { class: "key" });
    key.style.background = track.colour;
    const lowest = Math.min(...track.confidence.values());
    const words = track.gaussian === undefined ? "looking for the point"
      : `#${track.gaussian} · ${track.positions.size} frames · confidence ≥ ${lowest.toFixed(2)}`;
    return node("li", { "data-id": track.id }, key, node("span", {}, words),
      node("button", { type: "button", "aria-label": `Forget track ${track.name}`, onclick: () => forget(track) }, "×"));
  }));
  if (page.stream) view.draw();
}

// Pointer and keys.

function askForToken(again) {
  const door = $("door");
  if (door.open) return;
  if (again) $("door-words").textContent = "The token is wrong. Enter the token that the service was started with (SCAS4D_TOKEN).";
  token.forget();
  door.showModal();
  door.addEventListener("close", () => {
    token.set($("token").value.trim());
    $("token").value = "";
    page.gone = false;
    listScenes();
  }, { once: true });
}

$("scenes").addEventListener("change", (event) => openScene(event.target.value));
$("modes").addEventListener("click", (event) => event.target.dataset.mode && setMode(event.target.dataset.mode));
$("modes").addEventListener("keydown", (event) => {
  const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!by) return;
  event.preventDefault();
  const all = [...$("modes").children];
  const next = all[(all.indexOf(event.target) + by + all.length) % all.length];
  setMode(next.dataset.mode);
  next.focus();
});
$("part-count").querySelector("select").append(...[2, 3, 4, 5, 6, 8, 10, 12, 16, 24].map((count) => node("option", { value: count }, count)));
$("part-count").addEventListener("change", (event) => view.setParts(event.target.value ? Number(event.target.value) : null));
$("frusta").addEventListener("change", (event) => {
  view.showFrusta = event.target.checked;
  view.draw();
});
$("from").addEventListener("change", (event) => lookFrom(Number(event.target.value)));
$("time").addEventListener("input", (event) => {
  stopPlaying();
  choose(readable()[Number(event.target.value)]?.index ?? null);
});
$("play").addEventListener("click", play);
$("back").addEventListener("click", () => (stopPlaying(), stepBy(-1)));
$("forth").addEventListener("click", () => (stopPlaying(), stepBy(1)));
$("live").addEventListener("click", () => {
  stopPlaying();
  if (page.frame !== null) choose(null);
  else stepBy(0);
});
$("to-check").addEventListener("click", () => {
  $("warnings").scrollIntoView({ block: "nearest" });
  $("warnings-title").focus({ preventScroll: true });
});
$("clear").addEventListener("click", () => [...page.tracks].forEach(forget));
document.addEventListener("keydown", (event) => {
  if (event.target.matches("input:not([type=checkbox]), select, dialog *") || event.ctrlKey || event.altKey || event.metaKey || !page.stream) return;
  const modes = { 1: "colour", 2: "depth", 3: "parts", 4: "alpha" };
  if (modes[event.key]) setMode(modes[event.key]);
  else if (event.key === ",") stopPlaying(), stepBy(-1);
  else if (event.key === ".") stopPlaying(), stepBy(1);
  else if (event.key.toLowerCase() === "l") stopPlaying(), choose(null);
  else if (event.key.toLowerCase() === "c") lookFrom((Number($("from").value) + 1) % page.rig.cameras.length);
  else if (event.key === " " && !event.target.matches("button, input, summary")) play();
  else return;
  event.preventDefault();
});
window.addEventListener("hashchange", () => {
  const { scene, frame } = wanted();
  if (scene && scene !== page.scene) {
    closeScene();
    page.gone = false;
    listScenes();
  }
  else if (scene && frame && Number(frame) !== page.frame) choose(Number(frame));
});

setMode("colour");
curtain("Looking for scenes", "");
listScenes();
setInterval(listScenes, LIST_EVERY_MS);
document.addEventListener("visibilitychange", () => document.hidden || listScenes());
