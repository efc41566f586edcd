// Player in a page written by `scas4d export --player`, which contains the compact files and makes no network requests.

import { Clock } from "./clock.js";
import { PartList } from "../panels/parts.js";
import { takeFiles } from "./pieces.js";
import { $ } from "../page.js";
import { Splats } from "../splats/splats.js";
import { Pace } from "../splats/pace.js";
import { Orbit, project, readCamera } from "../view/geometry.js";
import { listenToPointer, moveByKey } from "../view/gestures.js";
import { Headset } from "../view/headset.js";
import { drawTracks } from "../view/overlay.js";

const SETTLE_MS = 220; // time at rest after which the picture is drawn sharp
const NOTE_MS = 6000;
const TRAIL_S = 1; // length of trails in seconds
const FOLLOWED = "#e69f00";
const LONE = { intrinsics: [[800, 0, 400], [0, 800, 300], [0, 0, 1]], width: 800, height: 600,
  world_to_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]] }; // camera for a file without cameras

const pace = new Pace();
let [splats, clock, orbit, rig] = [null, null, null, null];
let scene = null; // what the worker reported about the files
let shown = null; // { camera, place } of the current picture
let followed = null; // { row, positions, at }
let headset = null; // the session in a headset, while there is one
let [dirty, movedAt, tick, pictures] = [true, -Infinity, 0, 0];

// Opening.

async function open() {
  if (!Splats.possible()) return fail("This browser is not supported", "It has no WebGL2 in workers. Use a recent Firefox, Chrome or Edge, or Safari 17.");
  const source = new Blob([$("worker").textContent], { type: "text/javascript" });
  const worker = new Worker(URL.createObjectURL(source));
  splats = new Splats($("picture"), worker, { ready, frames, drawn, picked, track, failed, trails: () => draw(true) }, Infinity);
  let files = 0;
  try {
    await takeFiles((bytes, number) => (files++, splats.add(bytes, number)), (share) => ($("progress").value = share));
  } catch (error) {
    return fail("The file cannot be read", error.message);
  }
  if (!files) fail("This file is empty", "Export it again: scas4d export SOURCE --player OUT.html");
}

function ready({ floats }) {
  if (floats) return;
  const depth = $("modes").querySelector("[data-mode=depth]");
  depth.disabled = true;
  depth.title = "This browser cannot draw depth";
}

function fail(title, words) {
  $("curtain").hidden = false;
  $("progress").hidden = true;
  $("curtain-title").textContent = title;
  $("curtain-words").textContent = words;
}

function frames(message) {
  scene = message;
  const { head, parts, frames: all } = message;
  rig = (head.cameras?.length ? head.cameras : [LONE]).map(readCamera);
  orbit ??= new Orbit(rig);
  const time = clock?.time;
  const { playing, speed } = clock ?? { playing: false, speed: 1 };
  clock = Object.assign(new Clock(all.map(([, seconds]) => seconds)), { playing, speed });
  if (time !== undefined) clock.set(time);
  Object.assign($("time"), { min: clock.times[0], max: clock.times[clock.last] });
  for (const id of ["play", "back", "forth", "time"]) $(id).disabled = all.length < 2;
  partList.show(parts);
  $("parts-box").hidden = parts === 0;
  const named = $("modes").querySelector("[data-mode=parts]");
  named.disabled = parts === 0;
  if (!parts) named.title = "This file has no parts";
  trails();
  Headset.possible().then((possible) => ($("headset").hidden = !possible));
  if (message.damage) say(`Only part of the file can be read: ${message.damage}`);
  draw();
}

// Drawing.

const moving = () => clock.playing || performance.now() - movedAt < SETTLE_MS;

function draw(sharp = false) {
  dirty = true;
  if (!sharp) movedAt = performance.now();
}

/** Requests a picture if one is due; while one is being drawn, the page waits for it instead of for each refresh of the screen. */
function frame(now) {
  advance(now);
  if (!splats?.busy) requestAnimationFrame(frame);
}

function advance(now) {
  if (!clock || headset?.session) return;
  const began = performance.now();
  pass(now);
  if ((dirty || clock.playing) && !splats.busy) {
    const moves = moving();
    dirty = moves && pace.share < 1 && !clock.playing; // draws a sharp picture once at rest
    if (!dirty || performance.now() - movedAt < SETTLE_MS / 2 || !shown) request(moves);
  }
  measure("script", performance.now() - began);
}

function pass(now) {
  const passed = tick ? (now - tick) / 1000 : 0;
  tick = now;
  clock.pass(Math.min(passed, 0.5));
}

function request(moves) {
  const [width, height] = pace.size($("picture").parentElement.getBoundingClientRect(), moves);
  const camera = orbit.camera(width, height);
  const { place } = clock;
  const ahead = clock.playing ? (Math.ceil(place) + 1) % (clock.last + 1) : undefined;
  splats.draw({ place, camera, ahead }, { camera, place, share: moves ? pace.share : null });
}

function drawn({ asked: { camera, place, share }, milliseconds, range, followed: at }) {
  const began = performance.now();
  if (share) pace.took(milliseconds, share);
  $("curtain").hidden = true;
  shown = { camera, place };
  pictures++;
  if (followed) {
    if (at && followed.at && $("ride").checked) {
      orbit.target = orbit.target.map((value, k) => value + at[k] - followed.at[k]);
      dirty = true;
    }
    followed.at = at;
  }
  $("legend").hidden = !range;
  if (range) [$("near").textContent, $("far").textContent] = range.map((z) => z.toPrecision(3));
  showTime();
  drawOverlay();
  Object.assign(document.body.dataset, { pictures, place: place.toFixed(3), milliseconds: milliseconds.toFixed(1) });
  measure("shown", performance.now() - began);
  requestAnimationFrame(frame);
}

const spent = { script: 0, shown: 0 };
function measure(what, milliseconds) {
  spent[what] = Math.max(0.98 * spent[what], milliseconds);
  document.body.dataset.script = (spent.script + spent.shown).toFixed(2);
}

function showTime() {
  const nearest = Math.round(clock.place);
  const words = `frame ${scene.frames[nearest][0]} · ${clock.time.toFixed(2)} s`;
  if ($("moment").textContent === words) return;
  $("moment").textContent = words;
  $("time").value = clock.time;
  $("time").setAttribute("aria-valuetext", words);
}

function drawOverlay() {
  const canvas = $("overlay");
  const box = canvas.getBoundingClientRect();
  const dense = window.devicePixelRatio || 1;
  const [width, height] = [Math.round(box.width * dense), Math.round(box.height * dense)];
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  if (!followed) return;
  const camera = readCamera(shown.camera);
  const [sx, sy] = [width / camera.width, height / camera.height];
  const place = (point) => {
    const seen = project(camera, point);
    return seen && [seen[0] * sx, seen[1] * sy];
  };
  const positions = new Map(followed.positions);
  positions.set(shown.place, followed.at);
  drawTracks(context, place, [{ positions, colour: FOLLOWED }], shown.place, dense);
}

function failed({ during, words }) {
  if (during === "draw") requestAnimationFrame(frame);
  if (during === "file" || during === "begin" || (during === "draw" && !shown)) return fail("The scene cannot be shown", words);
  say(words);
}

let fading = 0;
function say(words) {
  clearTimeout(fading);
  $("note").textContent = words;
  fading = setTimeout(() => ($("note").textContent = ""), NOTE_MS);
}

// Following a Gaussian.

function click(event) {
  if (!shown || headset?.session) return;
  const box = $("overlay").getBoundingClientRect();
  splats.pick((event.clientX - box.left) / box.width * shown.camera.width, (event.clientY - box.top) / box.height * shown.camera.height);
}

function picked({ row, id, part, at }) {
  say(row < 0 ? "There is nothing at that point: click a surface" : "");
  if (row < 0) return;
  followed = { row, positions: new Map(), at };
  $("followed").hidden = false;
  $("followed-words").textContent = `Gaussian ${id}${part < 0 ? "" : `, part ${part + 1}`}`;
  drawOverlay();
}

function track({ row, track: found }) {
  if (followed?.row !== row) return;
  followed.positions = new Map(found);
  drawOverlay();
}

function forget() {
  if (!followed) return;
  splats.follow(-1);
  followed = null;
  $("followed").hidden = true;
  drawOverlay();
}

// Controls.

function setMode(mode) {
  const button = $("modes").querySelector(`[data-mode=${mode}]`);
  if (button.disabled) return;
  for (const one of $("modes").children) {
    one.setAttribute("aria-checked", String(one === button));
    one.tabIndex = one === button ? 0 : -1;
  }
  splats.look({ mode });
  draw(true);
}

function play() {
  if (!clock || clock.last < 1) return;
  clock.playing = !clock.playing;
  if (clock.playing && clock.time >= clock.times[clock.last]) clock.set(clock.times[0]);
  showPlaying();
  draw();
}

function showPlaying() {
  $("play").textContent = clock.playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", clock.playing ? "Pause" : "Play");
}

/** Shows the scene in a headset, until the button is pressed again or the person leaves. */
async function wear() {
  if (headset) return headset.end();
  const ended = () => {
    headset = null;
    draw();
  };
  headset = new Headset(splats, orbit, { moment: (now) => (pass(now), { place: clock.place }), pressed: play, ended });
  try {
    await headset.begin();
  } catch (error) {
    say(`The headset cannot be used: ${error.message}`);
  }
}

function step(count) {
  clock.step(count);
  showPlaying();
  draw(true);
}

function trails() {
  const rate = clock.last / Math.max(clock.times[clock.last] - clock.times[0], 1e-6);
  splats.look({ trails: Number($("trails").value), span: Math.max(2, Math.min(240, Math.round(rate * TRAIL_S))) });
  draw(true);
}

function choose(select, by) {
  select.selectedIndex = Math.max(0, Math.min(select.options.length - 1, select.selectedIndex + by));
  select.dispatchEvent(new Event("change"));
}

const partList = new PartList($("parts"), $("parts-words"), (hiddenParts) => {
  splats.look({ hiddenParts });
  draw(true);
});
const reset = () => (orbit.from(rig[0]), draw());

$("modes").addEventListener("click", (event) => event.target.dataset.mode && setMode(event.target.dataset.mode));
$("modes").addEventListener("keydown", (event) => {
  const by = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
  if (!by) return;
  event.preventDefault();
  const all = [...$("modes").children].filter((one) => !one.disabled);
  const next = all[(all.indexOf(event.target) + by + all.length) % all.length];
  setMode(next.dataset.mode);
  next.focus();
});
$("trails").addEventListener("change", trails);
$("fit").addEventListener("click", reset);
$("headset").addEventListener("click", wear);
$("play").addEventListener("click", play);
$("back").addEventListener("click", () => step(-1));
$("forth").addEventListener("click", () => step(1));
$("speed").addEventListener("change", () => (clock.speed = Number($("speed").value)));
$("forget").addEventListener("click", forget);
$("time").addEventListener("input", () => {
  clock.playing = false;
  clock.set(Number($("time").value));
  showPlaying();
  draw();
});
listenToPointer($("overlay"), () => orbit, { click, moved: () => ($("hint").classList.add("known"), draw()) });
new ResizeObserver(() => draw(true)).observe($("picture").parentElement);
document.addEventListener("click", (event) => event.target.closest("#parts-box") || ($("parts-box").open = false));

const keys = {
  " ": play, ",": () => step(-1), ".": () => step(1), "[": () => choose($("speed"), -1), "]": () => choose($("speed"), 1),
  1: () => setMode("colour"), 2: () => setMode("depth"), 3: () => setMode("parts"), escape: forget,
  r: () => choose($("trails"), $("trails").selectedIndex === $("trails").options.length - 1 ? -9 : 1),
  t: () => shown && splats.pick(shown.camera.width / 2, shown.camera.height / 2),
};
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || event.defaultPrevented || !clock) return;
  const { target, key } = event;
  if (target.matches("select") && (key.length > 1 || key === " ")) return;
  if (target.matches("button, summary, input[type=checkbox]") && (key === " " || key === "Enter")) return;
  if (target.matches("input[type=range]") && /Arrow|Home|End|Page/.test(key)) return;
  const action = keys[key.toLowerCase()];
  if (action) action();
  else if (moveByKey(orbit, event, rig[0])) draw();
  else return;
  event.preventDefault();
});

requestAnimationFrame(frame);
open();
