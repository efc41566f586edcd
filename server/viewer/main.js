// Main module of the page: opens a scene and passes its messages to the view and the panels.

import { Manage } from "./manage.js";
import { listenToKeys } from "./keys.js";
import { $, curtain, inOrder, node, note, page, sentence } from "./page.js";
import { ClusterView } from "./panels/cluster.js";
import { Figures } from "./panels/figures.js";
import { showCameras, showEffects, showFacts, showLatency, showQueue, showWarnings } from "./panels/facts.js";
import { PartList } from "./panels/parts.js";
import { TakeAway } from "./panels/takeaway.js";
import { Timeline } from "./panels/timeline.js";
import { Tour } from "./panels/tour.js";
import { Tracks } from "./panels/tracks.js";
import { Tradeoff } from "./panels/tradeoff.js";
import { SceneList, remember, wanted } from "./scenes.js";
import { call, scenePath, token } from "./service.js";
import { beforeFirstFrame, OPENING, stateKey, stateWords, WAKING } from "./states.js";
import { Stream } from "./stream.js";
import { Beside } from "./view/beside.js";
import { Headset } from "./view/headset.js";
import { LiveView } from "./view/live.js";

const SLEEP_TRIES = 10;
const FINISHED = ["committed", "failed", "missing", "skipped"];

const view = new LiveView($("picture"), $("overlay"), {
  pick: (...at) => {
    tracks.pick(...at);
    tour.did("point");
  },
  shown: showInfo,
  live: (times) => showLatency($("latency"), page.reports.get(times.frame), times),
  slow: (mode) => {
    const ready = page.status?.committed > 0;
    $("busy").hidden = !ready || page.lost;
    $("busy").textContent = mode === "parts" ? "Computing the parts …" : "Waiting for the picture …";
  },
  turned: () => {
    $("hint").classList.add("known");
    tour.did("orbit");
  },
  stale: (stale) => {
    $("view").classList.toggle("stale", stale);
    if (stale) $("legend").hidden = true;
  },
  parts: (count) => partList?.show(count),
});
const partList = new PartList($("parts"), $("parts-words"), (hiddenParts) => view.setExtras({ hiddenParts }));
const beside = new Beside($("beside"));
const timeline = new Timeline(() => {
  if (!timeline.playing) remember(); // browsers limit how often a page may change its URL
  view.setFrame(page.frame, true);
  showMoment();
  tour.did("time");
}, () => page.scene && remember(), { smooth: (...frames) => view.smooth(...frames), set: (...moment) => view.setBetween(...moment) });
const tracks = new Tracks(view);
const figures = new Figures((index) => timeline.choose(index));
const tradeoff = new Tradeoff($);
const takeAway = new TakeAway();
const tour = new Tour();
const manage = new Manage(showStatus, letGo);
const list = new SceneList(openScene, () => cluster.appear());
const cluster = new ClusterView((id) => list.called(id), (id) => list.choose(id));

// A scene.

async function openScene({ id, asleep }) {
  closeScene();
  page.scene = id;
  const hash = wanted();
  page.frame = hash.scene === id && hash.frame ? Number(hash.frame) : null;
  const opened = page.opened;
  remember();
  curtain(asleep ? WAKING : OPENING);
  let rig;
  try {
    rig = await call("GET", `${scenePath(id)}/rig`);
  } catch (error) {
    if (page.opened !== opened) return;
    page.scene = null;
    curtain({ title: "The scene cannot be opened", words: error.message });
    return;
  }
  if (page.opened !== opened) return;
  page.rig = rig;
  const named = rig.cameras.map((camera, index) => [index, camera.name]);
  for (const select of [$("from"), $("beside-camera")]) {
    select.replaceChildren(...named.map(([index, name]) => node("option", { value: index }, name)));
  }
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
  beside.look(0);
  tradeoff.open(id);
  takeAway.open(id);
  tour.wanted = hash.scene === id && hash.tour !== undefined;
  await loadReports();
}

function closeScene() {
  page.opened++;
  tour.hide();
  page.stream?.close();
  view.close();
  beside.close();
  tradeoff.close();
  takeAway.close();
  Object.assign(page, { stream: null, status: null, rig: null, scene: null, tracks: [], failed: null, lost: false });
  timeline.stop(); // otherwise it would keep the URL of the open scene
  page.reports.clear();
  tracks.show();
  manage.show();
  redraw();
  $("banner").hidden = $("state").hidden = $("trouble").hidden = $("manage-open").hidden = true;
  $("facts").replaceChildren();
  showWarnings($("warnings"), $("to-check"), []);
  $("queue").replaceChildren();
  $("latency").textContent = $("queue-words").textContent = $("note").textContent = "";
  $("cameras").replaceChildren();
  delete $("view").dataset.tag;
}

/** Closes the open scene, which keeps it awake, and puts it to sleep. */
async function letGo() {
  const { scene: id } = page;
  const name = page.status.name || id;
  closeScene();
  list.leave();
  $("connection").textContent = "Not connected";
  $("connection").classList.remove("good");
  curtain({ title: `${name} is falling asleep`, share: null });
  for (let tries = 0; ; tries++) {
    try {
      await call("POST", `${scenePath(id)}/sleep`);
      break;
    } catch (error) { // the service may not have noticed yet that this page has disconnected
      if (tries === SLEEP_TRIES) return curtain({ title: `${name} is still awake`, words: error.message, actions: [["Open it", () => list.choose(id)]] });
      await new Promise((done) => setTimeout(done, 300));
    }
  }
  await list.look();
  curtain({ title: `${name} is asleep`, words: "It has no processes and wakes up at the next request.",
    actions: [["Wake it", () => list.choose(id)], ...list.others(id)] });
}

function gone(reason, status) {
  const id = page.scene;
  closeScene();
  $("connection").textContent = "Not connected";
  $("connection").classList.remove("good");
  list.ended(id, reason, status);
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
    $("busy").hidden = true;
    $("banner").textContent = `The connection to the service was lost. Reconnecting in ${wait < 1 ? "a moment" : `${Math.round(wait)} s`}; the page shows the latest data received. If this persists, check that the service is running.`;
  }
}

function showStatus(status) {
  if (status.id !== page.scene) return;
  if (page.status && status.reconstruction !== page.status.reconstruction) return openScene(status); // the reconstruction was restarted
  page.status = status;
  const chip = $("state");
  chip.hidden = false;
  $("manage-open").hidden = token.reads();
  $("measure").hidden = $("budget-box").hidden = token.reads();
  chip.textContent = stateWords(status);
  chip.dataset.state = stateKey(status);
  $("trouble").hidden = !status.error;
  $("trouble").textContent = status.error ? sentence(status.error) + (status.state === "failed" ? (token.reads() ? "" : " Choose Begin again under Manage, or delete the scene.") : "") : "";
  showFacts($("facts"), status);
  showQueue($("queue"), $("queue-words"), status);
  showWarnings($("warnings"), $("to-check"), status.warnings);
  showEffects($("effects"), $("effects-words"), status.effects);
  manage.show();
  takeAway.show();
  const actions = token.reads() ? {} : { resume: () => manage.post("resume"), restore: () => manage.edit({ archived: false }, "") };
  if (!status.committed) curtain(beforeFirstFrame(status, actions));
  else if (!view.shown) curtain(status.asleep ? WAKING : OPENING);
  showMoment();
}

// Frames.

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
  if (FINISHED.includes(report.state)) page.reports.set(report.index, report);
}

function finished(report, missed) {
  keep(report);
  if (report.state === "committed") view.committed(report.index);
  if (missed) loadReports();
  else redraw();
  tradeoff.refresh();
}

function redraw() {
  figures.draw();
  tradeoff.follow(figures.updates);
  showMoment();
}

function showMoment() {
  const report = timeline.draw();
  figures.choose(report?.index ?? null);
  if (!page.rig) return;
  const reports = inOrder();
  const index = page.frame ?? reports.at(-1)?.index;
  const measured = reports.findLast((one) => one.state === "committed" && one.index <= index && Object.keys(one.cameras ?? {}).length);
  showCameras($("cameras"), $("camera-summary"), page.rig.cameras.map((camera) => camera.name), measured, lookFrom);
}

// The picture.

function bulk(head, bytes) {
  if (head.type === "render") view.receive(head, bytes).catch((error) => note(`The picture cannot be shown: ${error.message}`));
  else if (head.type === "states") view.receiveState(head, bytes);
  else if (head.type === "tracks") tracks.grow(head, JSON.parse(new TextDecoder().decode(bytes)));
}

function showInfo(info) {
  $("curtain").hidden = true;
  tour.start();
  if (info.here || info.tag === view.tag) $("busy").hidden = true;
  if (page.failed === "view") note("");
  const legend = $("legend");
  legend.hidden = info.mode !== "depth";
  if (!legend.hidden) {
    $("near").textContent = info.near.toPrecision(3);
    $("far").textContent = info.far.toPrecision(3);
  }
  const stage = $("view").dataset;
  Object.assign(stage, { frame: info.frame, mode: info.mode, tag: info.tag, size: `${info.width}x${info.height}`, drawn: info.here ? "here" : "service" });
  beside.draw(info.frame);
}

function failed(message) {
  const track = page.tracks.find((one) => one.id === message.id);
  if (track && !track.positions.size) tracks.forget(track);
  note(message.problem.detail, track ? null : message.id);
}

function setMode(mode) {
  if (mode === "parts") tour.did("parts");
  for (const button of $("modes").children) {
    button.setAttribute("aria-checked", String(button.dataset.mode === mode));
    button.tabIndex = button.dataset.mode === mode ? 0 : -1;
  }
  $("part-count").hidden = mode !== "parts";
  view.setMode(mode);
}

function lookFrom(index) {
  $("from").value = $("beside-camera").value = index;
  view.lookFrom(index);
  beside.look(index);
}

function showBeside(what) {
  $("beside-what").value = what;
  $("beside-camera-label").hidden = !what;
  beside.choose(what);
}

async function snapshot() {
  if (!view.shown) return;
  try {
    const link = node("a", { href: URL.createObjectURL(await view.snapshot()), download: `${page.status.name || page.scene}-frame-${view.shown.frame}-${view.shown.mode}.png` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  } catch (error) {
    note(error.message);
  }
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else $("stage").requestFullscreen?.().catch((error) => note(`Full screen is not available: ${error.message}`));
}

const wear = () => view.wear(() => timeline.play()).catch((error) => note(`The headset cannot be used: ${error.message}`));
Headset.possible().then((possible) => ($("headset").hidden = !(possible && view.here.possible)));

const fit = () => view.fit().catch((error) => note(error.message));

// Controls.

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
$("beside-what").addEventListener("change", (event) => showBeside(event.target.value));
$("beside-camera").addEventListener("change", (event) => beside.look(Number(event.target.value)));
$("background").addEventListener("change", (event) => view.setBackground(event.target.value ? JSON.parse(event.target.value) : null));
$("trails").addEventListener("change", (event) => view.setExtras({ trails: Number(event.target.value) }));
$("parts-box").addEventListener("toggle", () => $("parts-box").open && page.stream && view.askParts());
document.addEventListener("click", (event) => event.target.closest("#parts-box") || ($("parts-box").open = false));
$("who").addEventListener("change", (event) => view.setDrawn(event.target.value));
$("fit").addEventListener("click", fit);
$("snapshot").addEventListener("click", snapshot);
$("full").addEventListener("click", fullScreen);
$("headset").addEventListener("click", wear);
$("to-check").addEventListener("click", () => {
  $("warnings").scrollIntoView({ block: "nearest" });
  $("warnings-title").focus({ preventScroll: true });
});
const narrow = window.matchMedia("(max-width: 900px)");
const unfold = () => ($("more").open = !narrow.matches);
narrow.addEventListener("change", unfold);
unfold();
listenToKeys(view, {
  mode: setMode,
  step: (count) => timeline.step(count),
  live: () => timeline.live(),
  play: () => timeline.play(),
  nextCamera: () => lookFrom((Number($("from").value) + 1) % page.rig.cameras.length),
  beside: () => {
    const all = [...$("beside-what").options].map((option) => option.value);
    showBeside(all[(all.indexOf(beside.what) + 1) % all.length]);
  },
  fit,
  fullScreen,
  snapshot,
}, () => page.stream !== null);
window.addEventListener("hashchange", () => {
  const { scene, frame, token: link } = wanted();
  if (link) return location.reload(); // a share link was opened in a tab that already shows the page
  if (scene && scene !== page.scene) {
    closeScene();
    list.gone = false;
    list.look();
  } else if (scene && frame && Number(frame) !== page.frame) timeline.choose(Number(frame));
});

setMode("colour");
curtain({ title: "Looking for scenes", share: null });
list.look();
