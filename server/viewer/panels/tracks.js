// Tracks of clicked points, with their list.

import { TRACKS } from "../view/colours.js";
import { $, node, note, page } from "../page.js";

const MOST_TRACKS = 12;
const PICK_PX = 320;

/** Camera of the same view with a smaller picture. A pixel without a surface needs a depth map of this size. */
function smaller(camera) {
  const ratio = Math.min(1, PICK_PX / Math.max(camera.width, camera.height));
  const [width, height] = [Math.round(camera.width * ratio), Math.round(camera.height * ratio)];
  const [sx, sy] = [width / camera.width, height / camera.height];
  const k = camera.intrinsics;
  const intrinsics = [[k[0][0] * sx, 0, k[0][2] * sx], [0, k[1][1] * sy, k[1][2] * sy], k[2]];
  return { camera: { ...camera, width, height, intrinsics }, sx, sy };
}

export class Tracks {
  /** @param view live view that draws the tracks */
  constructor(view) {
    this.view = view;
    this.picks = 0;
    $("clear").addEventListener("click", () => [...page.tracks].forEach((track) => this.forget(track)));
  }

  /** Tracks the point at a pixel of a picture. */
  pick(u, v, camera, frame) {
    if (!page.stream) return;
    if (page.tracks.length >= MOST_TRACKS) this.forget(page.tracks[0]);
    const id = `track-${++this.picks}`;
    const used = new Set(page.tracks.map((track) => track.colour));
    const colour = TRACKS.find((one) => !used.has(one)) ?? TRACKS[this.picks % TRACKS.length];
    const where = `frame ${frame}, ${Math.round(100 * u / camera.width)}% from the left, ${Math.round(100 * v / camera.height)}% from the top`;
    page.tracks.push({ id, colour, where, name: this.picks, positions: new Map(), confidence: new Map() });
    const small = smaller(camera);
    page.stream.subscribe(id, "tracks", { pixels: [[u * small.sx, v * small.sy]], camera: small.camera, at: frame }, this.picks);
    this.show();
  }

  /** Adds received positions to a track. */
  grow(head, model) {
    const track = page.tracks.find((one) => one.id === head.id);
    if (!track) return;
    if (model.ids[0] < 0) {
      this.forget(track);
      note("There is no surface at that point: click one of the objects");
      return;
    }
    if (page.failed === null) note("");
    track.gaussian = model.ids[0];
    model.frames.forEach((frame, k) => {
      track.positions.set(frame, model.positions[0][k]);
      track.confidence.set(frame, model.confidence[0][k]);
    });
    this.show();
  }

  forget(track) {
    page.stream?.unsubscribe(track.id);
    page.tracks = page.tracks.filter((one) => one !== track);
    this.show();
  }

  show() {
    this.view.tracks = page.tracks;
    $("track-hint").hidden = page.tracks.length > 0;
    $("clear").hidden = page.tracks.length < 2;
    $("tracks").replaceChildren(...page.tracks.map((track) => this.row(track)));
    if (page.stream) this.view.draw();
  }

  row(track) {
    const key = node("span", { class: "key" });
    key.style.background = track.colour;
    const lowest = Math.min(...track.confidence.values());
    const words = track.gaussian === undefined ? "looking for the point"
      : `#${track.gaussian} · ${track.positions.size} frames · confidence ≥ ${lowest.toFixed(2)}`;
    return node("li", { "data-id": track.id }, key,
      node("span", {}, words, node("br"), node("small", {}, `clicked in ${track.where}`)),
      node("button", { type: "button", "aria-label": `Forget track ${track.name}`, onclick: () => this.forget(track) }, "×"));
  }
}
