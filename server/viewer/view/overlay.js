// Drawing of tracks and the rig over the picture.

import { add, scale } from "./geometry.js";

/** Draws each trajectory, with earlier frames as a solid line and later ones as a faint line. */
export function drawTracks(context, place, tracks, frame, dense) {
  context.lineJoin = context.lineCap = "round";
  for (const track of tracks) {
    const frames = [...track.positions.keys()].sort((a, b) => a - b);
    for (const past of [false, true]) {
      context.beginPath();
      let pen = false;
      for (const index of frames) {
        if (past ? index > frame : index < frame) {
          pen = false;
          continue;
        }
        const point = track.positions.get(index);
        const at = point && place(point);
        if (!at) pen = false;
        else if (pen) context.lineTo(...at);
        else context.moveTo(...at), pen = true;
      }
      for (const [width, colour, alpha] of [[4.5, "#000", 0.45], [2.25, track.colour, past ? 1 : 0.4]]) {
        context.lineWidth = width * dense;
        context.strokeStyle = colour;
        context.globalAlpha = alpha;
        context.stroke();
      }
    }
    const now = track.positions.get(frame);
    const at = now && place(now);
    if (!at) continue;
    context.globalAlpha = 1;
    context.beginPath();
    context.arc(...at, 4.5 * dense, 0, 2 * Math.PI);
    context.fillStyle = track.colour;
    context.fill();
    context.lineWidth = 1.5 * dense;
    context.strokeStyle = "#000";
    context.stroke();
  }
  context.globalAlpha = 1;
}

/** Tracks with interpolated points between a frame and the next one, at `frame + share * (next - frame)`. */
export function between(tracks, frame, next, share) {
  return tracks.map((track) => {
    const [begin, end] = [track.positions.get(frame), track.positions.get(next)];
    if (!begin || !end) return track;
    const at = begin.map((value, k) => value + share * (end[k] - value));
    return { ...track, positions: new Map(track.positions).set(frame + share * (next - frame), at) };
  });
}

/** Draws the cameras of the rig as pyramids with their names. */
export function drawFrusta(context, place, cameras, radius, dense) {
  const depth = 0.07 * radius;
  context.font = `${11 * dense}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.lineWidth = dense;
  for (const camera of cameras) {
    const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]].map(([u, v]) => {
      const ray = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1];
      const out = [0, 1, 2].map((k) => camera.rows[0][k] * ray[0] + camera.rows[1][k] * ray[1] + camera.rows[2][k] * ray[2]);
      return place(add(camera.centre, scale(out, depth)));
    });
    const tip = place(camera.centre);
    if (!tip || corners.some((corner) => !corner)) continue;
    context.beginPath();
    corners.forEach((corner, i) => {
      context.moveTo(...tip);
      context.lineTo(...corner);
      context.lineTo(...corners[(i + 1) % 4]);
    });
    context.strokeStyle = "rgba(0, 0, 0, 0.55)";
    context.lineWidth = 3 * dense;
    context.stroke();
    context.strokeStyle = "#7cc4ff";
    context.lineWidth = dense;
    context.stroke();
    context.fillStyle = "#cfe8ff";
    context.strokeStyle = "rgba(0, 0, 0, 0.7)";
    context.lineWidth = 3 * dense;
    context.strokeText(camera.name, tip[0], tip[1] - 5 * dense);
    context.fillText(camera.name, tip[0], tip[1] - 5 * dense);
  }
}
