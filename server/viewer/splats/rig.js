// Conversion of cameras from the user's world to the world of the states, and the colours of parts.

const NEAR_SHARE = 0.1; // near plane, as a share of the rig's radius (scas4d_core/rasterize/limits.py)
const WIDER = 1.1; // rig radius relative to the distance of the farthest camera (scas4d_core/cameras.py)
const LONE_RADIUS = 3; // rig radius in metres if all cameras are at one place
const NEAREST = 0.01; // near plane in metres if there is no rig

/** Distance of the near plane in metres, derived from the head of a file. */
export function nearOf(head) {
  const centres = (head.cameras ?? []).map(({ world_to_camera: m }) =>
    [0, 1, 2].map((k) => -(m[0][k] * m[0][3] + m[1][k] * m[1][3] + m[2][k] * m[2][3])));
  if (!centres.length) return NEAREST;
  const mean = [0, 1, 2].map((k) => centres.reduce((sum, centre) => sum + centre[k], 0) / centres.length);
  const far = Math.max(...centres.map((centre) => Math.hypot(...centre.map((value, k) => value - mean[k]))));
  const radius = WIDER * far * head.world.metres_per_unit;
  return NEAR_SHARE * (radius > 1e-8 ? radius : LONE_RADIUS);
}

/** Converts a camera in the service's format (world_to_camera, intrinsics, width, height) to the world of the states. */
export function inside(model, head, near) {
  const { origin, metres_per_unit: metres } = head.world;
  const pose = model.world_to_camera;
  const rows = [0, 1, 2].map((i) => pose[i].slice(0, 3));
  const t = rows.map((row, i) => metres * (row[0] * origin[0] + row[1] * origin[1] + row[2] * origin[2] + pose[i][3]));
  const k = model.intrinsics;
  return { rows, t, fx: k[0][0], fy: k[1][1], cx: k[0][2], cy: k[1][2], width: model.width, height: model.height, near };
}

/** Converts a point from the world of the states to the user's world. */
export const outside = (point, head) => point.map((value, k) => value / head.world.metres_per_unit + head.world.origin[k]);

const GOLDEN = 0.618033988749895;

/** RGB colour of a part, 0…255, equal to the service's (client/wire/parts.py). */
export function partColour(label) {
  const hue = 6 * ((0.58 + label * GOLDEN) % 1);
  const [saturation, value] = [[0.65, 0.45, 0.85][label % 3], [0.95, 0.8][label % 2]];
  const channel = (shift) => {
    const at = (shift + hue) % 6;
    return Math.round(255 * (value - value * saturation * Math.max(0, Math.min(at, 4 - at, 1))));
  };
  return [channel(5), channel(3), channel(1)];
}
