// Cameras and the orbit around a scene. OpenCV axes: x right, y down, z forward; X_cam = R X_world + t.

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);
export const unit = (a) => scale(a, 1 / (length(a) || 1));

/** Converts a camera from the service's format into rotation rows, centre and intrinsics. */
export function readCamera(model) {
  const pose = model.world_to_camera;
  const rows = [0, 1, 2].map((i) => pose[i].slice(0, 3));
  const t = [pose[0][3], pose[1][3], pose[2][3]];
  const centre = [0, 1, 2].map((k) => -(rows[0][k] * t[0] + rows[1][k] * t[1] + rows[2][k] * t[2]));
  const [fx, fy] = [model.intrinsics[0][0], model.intrinsics[1][1]];
  return { name: model.name, rows, t, centre, fx, fy, cx: model.intrinsics[0][2], cy: model.intrinsics[1][2],
    width: model.width, height: model.height };
}

/** Pixel and depth of a world point; null if it is behind the camera. */
export function project(camera, point) {
  const [x, y, z] = camera.rows.map((row, i) => dot(row, point) + camera.t[i]);
  return z > 1e-9 ? [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z] : null;
}

/** World point at a pixel and a depth along z. */
export function unproject(camera, u, v, z) {
  const seen = [(u - camera.cx) / camera.fx * z - camera.t[0], (v - camera.cy) / camera.fy * z - camera.t[1],
    z - camera.t[2]];
  return [0, 1, 2].map((k) => camera.rows[0][k] * seen[0] + camera.rows[1][k] * seen[1] + camera.rows[2][k] * seen[2]);
}

/** Solves a symmetric 3x3 system with Cramer's rule; null if it is (nearly) singular. */
function solve(m, b) {
  const det = (a) => dot(a[0], cross(a[1], a[2]));
  const d = det(m);
  const size = m.flat().reduce((most, value) => Math.max(most, Math.abs(value)), 0);
  if (Math.abs(d) < 1e-6 * size ** 3) return null;
  return [0, 1, 2].map((k) => det(m.map((row, i) => row.map((value, j) => (j === k ? b[i] : value)))) / d);
}

/** Estimates the point that a rig looks at, its up direction and its distance. */
export function fitRig(cameras) {
  const n = cameras.length;
  const forward = cameras.map((camera) => unit(camera.rows[2]));
  const mean = scale(cameras.reduce((sum, camera) => add(sum, camera.centre), [0, 0, 0]), 1 / n);
  // Down is the mean of the cameras' y axes, since rigs are upright no matter how the world's axes are named.
  const down = cameras.reduce((sum, camera) => add(sum, camera.rows[1]), [0, 0, 0]);
  const up = length(down) > 0.05 * n ? scale(unit(down), -1) : [0, -1, 0];
  // The point closest to all optical axes: sum of (I - f fT) (p - c) = 0.
  const m = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
  const b = [0, 0, 0];
  cameras.forEach((camera, i) => {
    for (let r = 0; r < 3; r++) for (let c = 0; c < 3; c++) {
      const value = (r === c ? 1 : 0) - forward[i][r] * forward[i][c];
      m[r][c] += value;
      b[r] += value * camera.centre[c];
    }
  });
  const spread = Math.max(...cameras.map((camera) => length(sub(camera.centre, mean)))) || 1;
  let target = n > 1 ? solve(m, b) : null;
  const inFront = (point) => cameras.filter((camera, i) => dot(sub(point, camera.centre), forward[i]) > 0).length;
  if (!target || inFront(target) < n / 2 || length(sub(target, mean)) > 20 * spread) {
    target = add(mean, scale(unit(forward.reduce(add, [0, 0, 0])), 2 * spread)); // parallel or diverging axes: a point in front of the cameras
  }
  const radius = cameras.map((camera) => length(sub(camera.centre, target))).sort((x, y) => x - y)[Math.floor(n / 2)];
  return { target, up, radius: radius || 1 };
}

const POLE = 88 * Math.PI / 180;
// Limits of the orbit's distance in radii of the rig: closer would be inside the scene, farther would make it a dot.
const [NEAREST, FARTHEST] = [0.05, 5];
const FILLED = 0.85;

/** Camera that orbits a target with a fixed up direction. */
export class Orbit {
  constructor(cameras) {
    this.cameras = cameras;
    this.rig = fitRig(cameras);
    const side = Math.abs(dot(this.rig.up, [1, 0, 0])) < 0.9 ? [1, 0, 0] : [0, 0, 1];
    this.axes = [null, null, this.rig.up];
    this.axes[0] = unit(sub(side, scale(this.rig.up, dot(side, this.rig.up))));
    this.axes[1] = cross(this.rig.up, this.axes[0]);
    this.from(cameras[0]);
  }

  /** Adopts the position and direction of a camera of the rig. */
  from(camera) {
    const ahead = unit(camera.rows[2]);
    const distance = Math.max(dot(sub(this.rig.target, camera.centre), ahead), 0.1 * this.rig.radius);
    this.target = add(camera.centre, scale(ahead, distance));
    this.distance = distance;
    const back = scale(ahead, -1);
    this.yaw = Math.atan2(dot(back, this.axes[1]), dot(back, this.axes[0]));
    this.pitch = Math.max(-POLE, Math.min(POLE, Math.asin(Math.max(-1, Math.min(1, dot(back, this.rig.up))))));
    // Half the sides of the picture at distance 1, so that all of it fits into any window.
    this.tangentX = camera.width / camera.fx / 2;
    this.tangentY = camera.height / camera.fy / 2;
  }

  eye() {
    const flat = Math.cos(this.pitch);
    const out = add(add(scale(this.axes[0], flat * Math.cos(this.yaw)), scale(this.axes[1], flat * Math.sin(this.yaw))),
      scale(this.rig.up, Math.sin(this.pitch)));
    return add(this.target, scale(out, this.distance));
  }

  /** Returns the camera in the service's format, for a picture of the given size. */
  camera(width, height) {
    const eye = this.eye();
    const z = unit(sub(this.target, eye));
    const x = unit(cross(z, this.rig.up));
    const y = cross(z, x);
    const rows = [x, y, z];
    const t = rows.map((row) => -dot(row, eye));
    const focal = Math.min(width / (2 * this.tangentX), height / (2 * this.tangentY));
    return {
      name: "view",
      intrinsics: [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
      world_to_camera: [...rows.map((row, i) => [...row, t[i]]), [0, 0, 0, 1]],
      width, height,
    };
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-POLE, Math.min(POLE, this.pitch + pitch));
  }

  /** Moves the target to the right and down, by shares of the picture's height. */
  pan(right, down) {
    const camera = readCamera(this.camera(100, 100));
    const size = 2 * this.tangentY * this.distance;
    this.target = add(this.target, add(scale(camera.rows[0], right * size), scale(camera.rows[1], down * size)));
  }

  zoom(factor) {
    this.distance = Math.max(NEAREST * this.rig.radius, Math.min(FARTHEST * this.rig.radius, this.distance * factor));
  }

  /** Centres a box of pixels of a picture, { left, top, right, bottom }, and makes it fill most of the view. */
  fit(box, picture) {
    const camera = readCamera(picture);
    const unit = this.distance / camera.fx; // world units per pixel at the target
    const right = (box.left + box.right + 1 - camera.width) / 2 * unit;
    const down = (box.top + box.bottom + 1 - camera.height) / 2 * unit;
    this.target = add(this.target, add(scale(camera.rows[0], right), scale(camera.rows[1], down)));
    this.zoom(Math.max((box.right + 1 - box.left) / camera.width, (box.bottom + 1 - box.top) / camera.height) / FILLED);
  }
}
