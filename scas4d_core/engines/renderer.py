"""Interface for rendering outside iterations, for example for checks, births, frame 0 and client views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log10
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import SMALLEST_SQUARE

Array = NDArray[np.float32]


CHANNELS = 4
"""Number of feature channels rendered per pass: red, green, blue, label."""
BLOCK = 4
"""Side length in pixels of the blocks in ``Renderer.reached``."""
PRIOR_PIXELS = 1.0
"""Constant, in pixels, that ``Renderer.step_colours`` adds to each Gaussian's total blending weight. It keeps the
colours of barely visible Gaussians almost unchanged."""

TURNED_TOGETHER = 32
"""Number of neighbouring Gaussians whose positions determine the rotation of a normal."""
PAIR_CAMERAS, PAIR_STEP = 2, 4
"""Maximum number of cameras, and step between the rows and columns, that ``pair_counts`` examines."""


class Picture(NamedTuple):
    """A rendered image. It may be a view into a renderer buffer, which the next call overwrites.

    Attributes:
        features: [C, H, W] float32 feature channels, before the camera's exposure is applied.
        transmittance: [H, W] float32 remaining transmittance.
    """

    features: Array
    transmittance: Array


def levels(values: Array) -> NDArray[np.uint8]:
    """Rounds values in [0, 1] to 8 bits; other values are clipped.

    >>> levels(np.float32([-1, 0.5, 2]))
    array([  0, 128, 255], dtype=uint8)
    """
    rounded: NDArray[np.uint8] = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return rounded


def psnr_of(squares: float, pixels: int) -> float:
    """Returns the PSNR in dB, given the squared error summed over pixels and RGB. It is finite even if the error is 0.

    >>> round(psnr_of(0.03 * 64, pixels=64), 6)  # an error of 0.1 in every value
    20.0
    """
    return 10 * log10(3 * pixels / max(squares, SMALLEST_SQUARE))


class Comparison(NamedTuple):
    """Comparison of a rendered state with the training image of a view.

    Attributes:
        psnr: PSNR of the rendering, in dB.
        image_loss: weighted image loss, 0.8 L1 + 0.2 (1 − SSIM).
        colour_shift: [3] mean of the training image minus mean of the rendering, RGB in [0, 1], with exposure applied.
    """

    psnr: float
    image_loss: float
    colour_shift: tuple[float, float, float]


class Gradients(NamedTuple):
    """Gradients of a loss with respect to the renderer's inputs, in buffers that the next call overwrites.

    Gaussians that are not rendered have zero gradients.

    Attributes:
        means: [N, 3] gradients of the means.
        factors: [N, 3, 3] gradients of the covariance factors.
        opacities: [N] gradients of the opacities.
        features: [N, C] gradients of the features.
        screen: [N, 2] gradients of the projected means.
    """

    means: Array
    factors: Array
    opacities: Array
    features: Array
    screen: Array


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """Neighbourhoods of Gaussians, which the host only searches if a renderer reads ``rows``.

    Args:
        means: [M, 3] positions in metres, of the first M Gaussians.
    """

    means: Array

    @property
    def count(self) -> int:
        """Number of Gaussians in each neighbourhood."""
        return min(TURNED_TOGETHER, len(self.means))

    @cached_property
    def rows(self) -> NDArray[np.int64]:
        """[M, count] rows of the nearest Gaussians, starting with the Gaussian itself."""
        from scipy.spatial import cKDTree  # deferred import: workers and readers start without SciPy

        nearest: NDArray[np.int64] = np.asarray(cKDTree(self.means).query(self.means, self.count)[1])
        return nearest.reshape(len(self.means), -1)


class Renderer(Protocol):
    """Interface of a renderer for the states of one scene, with the scene's background and limits.

    The rendered colours include view-dependent gloss. If ``features`` [N, C] are given, they are rendered instead of
    RGB and label. C must be a multiple of ``CHANNELS``.
    """

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """Renders the colours and labels of a state from a camera, without applying the camera's exposure.

        Args:
            state: Gaussians to render.
            camera: camera in kernel format.
            features: [N, C] features to render instead of RGB and label.
            depth_channel: channel of ``features`` to overwrite with the depth of each mean (metres along z), or −1.
            background: [C] float32 background. If None, the scene's background is used for RGB and 0 for all other
                channels.
        """

    def render_each(
        self, shots: Sequence[tuple[Gaussians, CameraArrays]], *, depth_channel: int = -1
    ) -> Iterator[Picture]:
        """Renders several pairs of a state and a camera, in order; see ``render``.

        Pictures may be rendered only when they are requested. Use or copy each one before the next call of the
        renderer, which may overwrite it. On a GPU, the host waits once for several pictures.

        Args:
            shots: states, with the same number of Gaussians each, and cameras in kernel format.
            depth_channel: channel to overwrite with the depth of each mean (metres along z), or −1.
        """

    def render_levels(
        self, state: Gaussians, camera: CameraArrays, background: Array, *, opacity: bool
    ) -> NDArray[np.uint8]:
        """Renders the colours of a state, or its opacity, in 8 bits; see ``render`` and ``levels``.

        Args:
            state: Gaussians to render.
            camera: camera in kernel format.
            background: [4] float32 background.
            opacity: whether to return the opacity [H, W] instead of the colours [H, W, 3].
        """

    def compare(self, state: Gaussians, views: Sequence[TrainingView]) -> list[Comparison]:
        """Returns one comparison per view, of a rendering of the state with the view's training image."""

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """Returns the sums [N, P] of ``planes`` [P, H, W] over pixels, weighted by each Gaussian's blending weights.

        P is at most 4. For a plane of ones, the sum is the Gaussian's total blending weight, in pixels.
        """

    def step_colours(
        self, state: Gaussians, subsets: Sequence[Sequence[TrainingView]], learnt: NDArray[np.uint8], most: float
    ) -> Gaussians:
        """Returns a state whose colours are corrected step by step by the mean residual of some views.

        Each step renders the colours of the step before. The mean is weighted by blending weights. The residual of a
        pixel is the training image minus the rendering, before exposure.

        Args:
            state: Gaussians to render.
            subsets: training views of each step, in order.
            learnt: [N] mask that is 1 for Gaussians whose colours are corrected, and 0 for all others.
            most: magnitude to which residuals are clipped; RGB values are in [0, 1].
        """

    def extrapolate(self, before: Gaussians, after: Gaussians, share: float) -> Gaussians:
        """Returns a state moved further along its motion; see ``extrapolated``."""

    def turn_normals(self, before: Gaussians, after: Gaussians, near: Neighbourhoods) -> Gaussians:
        """Returns a state whose normals rotated with their neighbourhoods since an earlier state.

        Normals rotate with their neighbourhood rather than with their own Gaussian. A normal belongs to a surface, and
        positions do not accumulate the errors of earlier frames. On `gloss`, both variants produced the
        same result.

        Args:
            before: state Θ_{t−1}.
            after: state Θ_t with gloss.
            near: neighbourhoods of the Gaussians with gloss.
        """

    def reached(self, state: Gaussians, cameras: Sequence[CameraArrays]) -> list[NDArray[np.bool_]]:
        """Finds the ``BLOCK``-pixel blocks of each camera's image that the supports of moving Gaussians intersect.

        Returns:
            One mask [h, w] for each camera. It covers the image padded to a multiple of 32 pixels.
        """

    def pairs_per_pixel(
        self, state: Gaussians, cameras: Sequence[CameraArrays], every: int = 1
    ) -> list[NDArray[np.int32]]:
        """Returns the number of Gaussians that are blended into each pixel, which determines the rendering time.

        Gaussians behind the one that finishes a pixel do not count.

        Args:
            state: Gaussians to render.
            cameras: one or more cameras in kernel format.
            every: step between the rows and columns to count.

        Returns:
            One [⌈H / every⌉, ⌈W / every⌉] array for each camera.
        """


@dataclass(frozen=True)
class PairCounts:
    """Statistics of the number of Gaussians that are blended into a pixel.

    Attributes:
        mean: mean over the pixels.
        percentile_99: number that 99% of the pixels do not exceed.
    """

    mean: float
    percentile_99: int


def pair_counts(renderer: Renderer, state: Gaussians, cameras: Sequence[CameraArrays]) -> PairCounts:
    """Counts the Gaussians blended into a sample of the pixels of at most ``PAIR_CAMERAS`` cameras.

    >>> from scas4d_core.cameras import Camera
    >>> from scas4d_core.engines.choose import renderer_of
    >>> from scas4d_core.engines.limits import DEFAULT
    >>> state = Gaussians.of_points([[0, 0, 2], [0, 0, 3]], radius=10, colours=[1, 0, 0])
    >>> camera = Camera("front", [[100, 0, 16], [0, 100, 16], [0, 0, 1]], np.eye(4), 32, 32)
    >>> pair_counts(renderer_of("cpu", (0, 0, 0), DEFAULT), state, [CameraArrays.of(camera)])
    PairCounts(mean=2.0, percentile_99=2)
    """
    chosen = cameras[:: -(-len(cameras) // PAIR_CAMERAS)]
    pairs = np.concatenate([pairs.ravel() for pairs in renderer.pairs_per_pixel(state, chosen, PAIR_STEP)])
    below = np.cumsum(np.bincount(pairs))
    return PairCounts(float(pairs.mean()), int(np.searchsorted(below, 0.99 * len(pairs))))


def extrapolated(before: Gaussians, after: Gaussians, share: float) -> Gaussians:
    """Returns a state moved further along the motion between two states; only means and factors change.

    Args:
        before: state Θ_{t−1}.
        after: state Θ_t of the same Gaussians.
        share: fraction of the motion to add. A negative fraction moves the state back.
    """

    def moved(old: Array, new: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):  # Gaussians that are held back may not be finite
            farther = new + np.float32(share) * (new - old)
        return np.where(after.moving.reshape(-1, *[1] * (new.ndim - 1)), farther, new)

    return after.replace(means=moved(before.means, after.means), factors=moved(before.factors, after.factors))
