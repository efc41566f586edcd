"""SIFT matches between neighbouring cameras by appearance alone: a faulty calibration cannot hide itself in them.

The matches from which points are made (``points/triangulation.py``) lie within two pixels of their epipolar lines, by
the calibration as given. These here are searched in whole pictures: they are fewer, and say how far off it is.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.images import resize_area
from scas4d_core.first_frame.points.triangulation import (
    descriptor_distances,
    extract_features,
    fundamental_matrix,
    label_tracks,
    mutual_best,
)
from scas4d_core.posed_pictures import Float, PosedPicture

LONGEST_SIDE = 800
"""Pixels; larger pictures are made smaller before features are found: they would show smaller faults, at seconds a
camera."""
FEATURES, CONTRAST = 2048, 0.0067
"""Features of a picture at most, and COLMAP's least contrast: of `basketball` half as many as points are made from, of
which as many match. Where the pictures are of one size they are some of those that points are made from, bit by bit in
50 of 51 pictures; but which, pycolmap does not say: it gives keypoints without their contrast. So features are found
twice, at up to 1.0 s of the processor for `robot`, 3.0 s for `basketball`."""
NEIGHBOURS = 6
"""Cameras that look most like a camera and are matched with it: pictures taken farther apart hardly match."""
HELD_OUT_EVERY = 5
"""Every so many tracks are held out, to test with."""

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Matches:
    """Features of the pictures of one moment, and those that look alike from camera to camera.

    Attributes:
        cameras: as given, of the size at which features were found.
        scale: by camera, how many pixels of its picture one of these is, at least 1.
        pixels: by camera, [K, 2] of its features. pairs: [M, 2] features that match, by indices of two cameras.
    """

    cameras: tuple[Camera, ...]
    scale: Float
    pixels: list[Float]
    pairs: dict[Pair, NDArray[np.intp]]

    def with_cameras(self, cameras: Sequence[Camera]) -> Matches:
        """The same features, of the rig in another calibration; cameras are of the size of these."""
        return replace(self, cameras=tuple(cameras))

    def without(self, left_out: Collection[int]) -> Matches:
        """The matches between all other cameras."""
        pairs = {pair: rows for pair, rows in self.pairs.items() if not set(pair) & set(left_out)}
        return replace(self, pairs=pairs)

    def tracks(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """The track of each feature, those of all cameras in a row, and the first place of each camera in it."""
        offsets = np.concatenate([[0], np.cumsum([len(uv) for uv in self.pixels])])
        edges = [rows + offsets[list(pair)] for pair, rows in self.pairs.items()]
        all_edges = np.concatenate(edges) if edges else np.zeros((0, 2), np.intp)
        return label_tracks(all_edges, int(offsets[-1])), offsets

    def split(self) -> tuple[Matches, Matches]:
        """Those to learn from, and those held out: no feature is in both."""
        track, offsets = self.tracks()
        # Tracks are numbered by their first features: counted among those that match, both halves have all cameras.
        matched = np.concatenate(
            [np.zeros(0, np.intp), *(track[r + offsets[list(p)]][:, 0] for p, r in self.pairs.items())]
        )
        order = np.unique(matched)
        held = {pair: np.searchsorted(order, track[rows[:, 0] + offsets[pair[0]]]) % HELD_OUT_EVERY == 0
                for pair, rows in self.pairs.items()}  # fmt: skip
        learnt = {pair: rows[~held[pair]] for pair, rows in self.pairs.items()}
        return replace(self, pairs=learnt), replace(self, pairs={p: rows[held[p]] for p, rows in self.pairs.items()})


def match_by_appearance(views: Sequence[PosedPicture]) -> Matches:
    """Matches SIFT features of each camera with those of its neighbours in direction and place.

    Args:
        views: of one moment, of two cameras or more.
    """
    small = [_downscale(view) for view in views]
    feature_sets = extract_features(small, most=FEATURES, contrast=CONTRAST)
    pairs = {
        (a, b): _mutual_matches(feature_sets[a][1], feature_sets[b][1])
        for a, b in neighbour_pairs(Rig(tuple(view.camera for view in small)))
    }
    scale = np.array([view.camera.width / less.camera.width for view, less in zip(views, small, strict=True)])
    return Matches(tuple(view.camera for view in small), scale, [uv for uv, _ in feature_sets], pairs)


def _downscale(view: PosedPicture) -> PosedPicture:
    longest = max(view.camera.width, view.camera.height)
    if longest <= LONGEST_SIDE:
        return view
    camera = view.camera.scaled(LONGEST_SIDE / longest)
    return PosedPicture(camera, resize_area(view.image, (camera.width, camera.height)))


def neighbour_pairs(rig: Rig) -> list[Pair]:
    """Pairs of cameras worth matching: each with the ``NEIGHBOURS`` that are nearest in direction and place.

    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> row = [np.eye(4) for _ in range(9)]
    >>> for i, pose in enumerate(row):
    ...     pose[0, 3] = -i
    >>> cameras = tuple(Camera(str(i), lens, pose, 64, 48) for i, pose in enumerate(row))
    >>> pairs = neighbour_pairs(Rig(cameras))
    >>> (0, 6) in pairs, (0, 7) in pairs
    (True, False)
    """
    axes = np.array([camera.rotation[2] for camera in rig.cameras])
    centres = np.array([camera.centre for camera in rig.cameras])
    apart = np.linalg.norm(centres[:, None] - centres, axis=-1) / rig.radius
    far = np.arccos(np.clip(axes @ axes.T, -1, 1)) + apart
    near = np.argsort(far, axis=1, kind="stable")
    chosen = {
        (min(a, int(b)), max(a, int(b)))
        for a in range(len(rig))
        for b in [other for other in near[a] if other != a][:NEIGHBOURS]
    }
    return sorted(chosen)


def _mutual_matches(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.intp]:
    """[M, 2] rows of two sets of unit descriptors that are each other's nearest, and much nearer than any other."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.intp)
    return mutual_best(descriptor_distances(first, second))


def epipolar_distances(matches: Matches, pair: Pair) -> Float:
    """[M] pixels by which the matches of a pair miss each other's epipolar lines: the larger distance of the two."""
    (a, b), rows = pair, matches.pairs[pair]
    first, second = (np.pad(matches.pixels[v][rows[:, k]], ((0, 0), (0, 1)), constant_values=1.0)
                     for k, v in enumerate((a, b)))  # fmt: skip
    matrix = fundamental_matrix(matches.cameras[a], matches.cameras[b])
    there, here = first @ matrix.T, second @ matrix
    slope = np.minimum(np.linalg.norm(there[:, :2], axis=1), np.linalg.norm(here[:, :2], axis=1))
    distance: Float = np.abs(np.einsum("mi,mi->m", there, second)) / np.maximum(slope, 1e-12)
    return distance
