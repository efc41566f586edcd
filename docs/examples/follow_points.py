"""Plots the trajectories of the points that move most: python docs/examples/follow_points.py out/reconstruct

SOURCE is the output folder of `scas4d reconstruct`, a .s4d file, or the id of a scene on the service. Requires
matplotlib and the client (pip install -e .).
"""

import argparse

import matplotlib

matplotlib.use("Agg")  # no window
import matplotlib.pyplot as plt
import numpy as np

from client.scene import Scene

asked = argparse.ArgumentParser(description=__doc__)
asked.add_argument("source")
asked.add_argument("--out", default="follow_points.png")
asked.add_argument("--count", type=int, default=25, help="number of points")
given = asked.parse_args()

with Scene.open(given.source) as scene:
    tracks = scene.tracks()  # [T, K, 3] for all Gaussians that move in the last frame, in the rig's world and units
    last = next(scene.states(str(scene.frames[-1])))
    rig, millimetres = scene.rig, 1000 * scene.metres_per_unit

# Length of each trajectory. It is NaN for Gaussians that are not present in every frame, which are ranked last.
lengths = np.linalg.norm(np.diff(tracks.positions, axis=0), axis=2).sum(axis=0)
ranked = np.argsort(-np.nan_to_num(lengths))
# Select evenly from the quarter that moves most, so that the points are not all in one place.
chosen = ranked[: max(given.count, len(ranked) // 4)][:: max(1, len(ranked) // 4 // given.count)][: given.count]
for k in chosen[:5]:
    print(f"Gaussian {tracks.ids[k]}: {lengths[k] * millimetres:.0f} mm in {np.ptp(tracks.seconds):.2f} s")

# The plot uses the axes of the first camera, with the vertical axis pointing up.
across, down, ahead = rig.cameras[0].rotation if rig is not None else np.eye(3)
figure, axes = plt.subplots(subplot_kw={"projection": "3d"}, figsize=(7, 7), layout="constrained")


def drawn(points):
    """Converts points [..., 3] to plot coordinates: right, away, up."""
    return np.moveaxis(np.stack([points @ across, points @ ahead, -points @ down], axis=-1), -1, 0)


some = np.flatnonzero(last.present & (last.opacities > 0.5))
axes.scatter(*drawn(last.means[some]), c=np.clip(last.colours[some], 0, 1), s=3, linewidths=0)
speeds = np.linalg.norm(np.diff(tracks.positions[:, chosen], axis=0), axis=2) / np.diff(tracks.seconds)[:, None]
for k, speed in zip(chosen, speeds.T, strict=True):
    way = drawn(tracks.positions[:, k])
    for step in range(way.shape[1] - 1):
        axes.plot(*way[:, step : step + 2], color=plt.cm.plasma(speed[step] / np.nanmax(speeds)), linewidth=1.5)
figure.colorbar(
    plt.cm.ScalarMappable(plt.Normalize(0, np.nanmax(speeds) * scene.metres_per_unit), plt.cm.plasma),
    ax=axes,
    label="speed, m/s",
    shrink=0.6,
)
axes.set(xlabel="right", ylabel="away", zlabel="up", title=f"{len(chosen)} of {len(ranked)} points that move")
axes.set_aspect("equal")
axes.view_init(elev=15, azim=-75)
figure.savefig(given.out, dpi=110)
print(given.out)
