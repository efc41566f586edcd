"""SIFT matches between neighbouring cameras, based only on appearance.

The matches for the initial points (``points/triangulation.py``) must be within two pixels of the
epipolar lines of the given calibration. Here, the whole image is searched, so calibration errors do
not bias the matches. This search yields fewer matches, but they reveal the size of a calibration
error.
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
"""Maximum image side, in pixels. Larger images are downscaled before feature detection. Images at
full size would reveal smaller errors but would take seconds per camera."""
FEATURES, CONTRAST = 2048, 0.0067
"""Maximum number of features per image, and the contrast threshold of COLMAP. On `basketball`,
these values yield half as many features as the initial points use, but the same number of matches.
For images of the same size, the features are a bit-identical subset of the features for the initial
points in 50 of 51 images. The subset cannot be selected, because pycolmap returns keypoints without
their contrast. Features are therefore detected twice, which takes up to 1.0 s of CPU time for
`robot` and 3.0 s for `basketball`."""
NEIGHBOURS = 6
"""Number of nearest cameras with which each camera is matched. More distant views hardly match."""
HELD_OUT_EVERY = 5
"""One in this many tracks is held out for testing."""

Pair = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Matches:
    """Features of the images of one frame, and the matches between cameras.

    Attributes:
        cameras: calibrated cameras, at the image size used for feature detection.
        scale: factor from the size for feature detection to the full size of each camera's image,
            at least 1.
        pixels: [K, 2] feature positions of each camera.
        pairs: maps each pair of camera indices to the [M, 2] indices of their matching features.
        descriptors: [K, 128] descriptors of the features of each camera; empty if unknown.
    """

    cameras: tuple[Camera, ...]
    scale: Float
    pixels: list[Float]
    pairs: dict[Pair, NDArray[np.intp]]
    descriptors: Sequence[NDArray[np.float32]] = ()

    def with_exchanged_images(self, a: int, b: int) -> Matches:
        """Returns the matches after exchanging the images of two cameras, which must have the same size."""
        pixels, descriptors = list(self.pixels), list(self.descriptors)
        pixels[a], pixels[b] = pixels[b], pixels[a]
        descriptors[a], descriptors[b] = descriptors[b], descriptors[a]
        again = {
            pair: _mutual_matches(descriptors[pair[0]], descriptors[pair[1]]) if {a, b} & {*pair} else rows
            for pair, rows in self.pairs.items()
        }
        return replace(self, pixels=pixels, descriptors=descriptors, pairs=again)

    def with_cameras(self, cameras: Sequence[Camera]) -> Matches:
        """Returns the same matches for a different calibration with the same image sizes."""
        return replace(self, cameras=tuple(cameras))

    def without(self, left_out: Collection[int]) -> Matches:
        """Returns the matches that do not involve any of the given cameras."""
        pairs = {pair: rows for pair, rows in self.pairs.items() if not set(pair) & set(left_out)}
        return replace(self, pairs=pairs)

    def tracks(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Joins matching features to tracks.

        Returns:
            The track index of each feature, concatenated over the cameras, and the index of the
            first feature of each camera, followed by the number of features.
        """
        offsets = np.concatenate([[0], np.cumsum([len(uv) for uv in self.pixels])])
        edges = [rows + offsets[list(pair)] for pair, rows in self.pairs.items()]
        all_edges = np.concatenate(edges) if edges else np.zeros((0, 2), np.intp)
        return label_tracks(all_edges, int(offsets[-1])), offsets

    def split(self) -> tuple[Matches, Matches]:
        """Splits the matches into a training set and a held-out set that share no features."""
        track, offsets = self.tracks()
        # Tracks without matches are not counted. The others are numbered in the order of their
        # first features, so that both sets cover all cameras.
        matched = np.concatenate(
            [np.zeros(0, np.intp), *(track[r + offsets[list(p)]][:, 0] for p, r in self.pairs.items())]
        )
        order = np.unique(matched)
        held = {pair: np.searchsorted(order, track[rows[:, 0] + offsets[pair[0]]]) % HELD_OUT_EVERY == 0
                for pair, rows in self.pairs.items()}  # fmt: skip
        learnt = {pair: rows[~held[pair]] for pair, rows in self.pairs.items()}
        return replace(self, pairs=learnt), replace(self, pairs={p: rows[held[p]] for p, rows in self.pairs.items()})


def match_by_appearance(views: Sequence[PosedPicture]) -> Matches:
    """Matches the SIFT features of each camera with those of its neighbours in direction and position.

    Args:
        views: views of one frame, from at least two cameras.
    """
    small = [_downscale(view) for view in views]
    feature_sets = extract_features(small, most=FEATURES, contrast=CONTRAST)
    pairs = {
        (a, b): _mutual_matches(feature_sets[a][1], feature_sets[b][1])
        for a, b in neighbour_pairs(Rig(tuple(view.camera for view in small)))
    }
    scale = np.array([view.camera.width / less.camera.width for view, less in zip(views, small, strict=True)])
    pixels, descriptors = map(list, zip(*feature_sets, strict=True))
    return Matches(tuple(view.camera for view in small), scale, pixels, pairs, descriptors)


def _downscale(view: PosedPicture) -> PosedPicture:
    longest = max(view.camera.width, view.camera.height)
    if longest <= LONGEST_SIDE:
        return view
    camera = view.camera.scaled(LONGEST_SIDE / longest)
    return PosedPicture(camera, resize_area(view.image, (camera.width, camera.height)))


def neighbour_pairs(rig: Rig) -> list[Pair]:
    """Returns the pairs of cameras to match.

    Each camera is matched with the ``NEIGHBOURS`` cameras nearest in direction and position.

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
    """Returns the indices [M, 2] of mutual nearest descriptors that pass the ratio test."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.intp)
    return mutual_best(descriptor_distances(first, second))


def epipolar_distances(matches: Matches, pair: Pair) -> Float:
    """Returns the epipolar distances [M] of the matches between two cameras, in pixels.

    The distance of a match is the larger of its distances in the two images.
    """
    (a, b), rows = pair, matches.pairs[pair]
    first, second = (np.pad(matches.pixels[v][rows[:, k]], ((0, 0), (0, 1)), constant_values=1.0)
                     for k, v in enumerate((a, b)))  # fmt: skip
    matrix = fundamental_matrix(matches.cameras[a], matches.cameras[b])
    there, here = first @ matrix.T, second @ matrix
    slope = np.minimum(np.linalg.norm(there[:, :2], axis=1), np.linalg.norm(here[:, :2], axis=1))
    distance: Float = np.abs(np.einsum("mi,mi->m", there, second)) / np.maximum(slope, 1e-12)
    return distance
