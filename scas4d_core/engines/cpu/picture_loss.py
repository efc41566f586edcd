"""Makes training views, and the loss of one: rendered, compared and carried back, in frame 0 and in every iteration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import log10, prod

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.captures.images import area_average, resize_area
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import SMALLEST_SQUARE
from scas4d_core.kernels import image_loss
from scas4d_core.rasterize.cpu import CameraArrays, CpuRasterizer, Drawing, Gradients, Picture
from scas4d_core.rasterize.limits import DEFAULT, Limits
from scas4d_core.update.training_view import TrainingView, means

Array = NDArray[np.float32]

CHANNELS = 4
"""Red, green, blue, label."""
LABEL = 3
"""The label's channel."""


class ViewFactory:
    """Makes the training views of each frame of a rig; keeps the cameras and the scratch of the image loss.

    Args:
        rig: the cameras inside. source: the cameras as the pictures come in, where they are to be resized.

    Attributes:
        posed: the rig as it stands by now, of which the views are.
    """

    def __init__(self, rig: Rig, source: Rig | None = None) -> None:
        self.rig = self.posed = rig
        self._source = source
        self._scratch: dict[tuple[int, int, int], Array] = {}

    def scratch(self, channels: int, height: int, width: int) -> Array:
        """Zero-bordered scratch of the image loss, one per size."""
        key = (channels, height, width)
        if key not in self._scratch:
            self._scratch[key] = np.zeros(
                (6, channels, height + 2 * image_loss.REACH, image_loss.stride(width)), np.float32
            )
        return self._scratch[key]

    def scaled(self, frame: Frame) -> Frame:
        """The frame with its pictures of the rig's cameras at the size that those have.

        Raises:
            ValueError: a picture or a mask is not of the size that it should come in.
        """
        if self._source is None:
            return frame
        images, masks = {}, {}
        for camera in self.rig.cameras:
            name, size = camera.name, (camera.width, camera.height)
            if name in frame.images:
                image, mask = pictures_of(frame, name, (self._source[name].width, self._source[name].height))
                images[name] = resize_area(image, size)
                if mask is not None:
                    masks[name] = (resize_area(255 * mask, size) >= 128).astype(np.uint8)
        return Frame(frame.index, frame.time, images, masks)

    def views(self, frame: Frame, exposures: dict[str, Array], use_masks: bool = True) -> list[TrainingView]:
        """The views of a frame, in the rig's order; cameras that the frame lacks are left out.

        Args:
            exposures: [3, 2] gain and offset per camera; a camera that is not named has 1 and 0.

        Raises:
            ValueError: a picture's size is not its camera's, or no camera of the rig is in the frame.
        """
        views = []
        for name in self.rig.names:
            if name not in frame.images:
                continue
            camera = CameraArrays.of(self.posed[name])
            image, mask = pictures_of(frame, name, (camera.width, camera.height), use_masks)
            masked = mask is not None
            target = np.empty((3 + masked, camera.height, camera.width), np.float32)
            np.multiply(np.moveaxis(image, -1, 0), np.float32(1 / 255), out=target[:3])
            if masked:
                target[3] = mask
            exposure = np.tile(np.array([1, 0], np.float32), (3 + masked, 1))
            exposure[:3] = exposures.get(name, exposure[:3])
            views.append(self._view(name, camera, target, exposure))
        if not views:
            raise ValueError(f"frame {frame.index} has none of the rig's cameras ({', '.join(self.rig.names)})")
        return views

    def coarser(self, view: TrainingView, scale: float) -> TrainingView:
        """The view with its pictures resized by area averaging, and the camera that sees them so."""
        camera = self.posed[view.name].scaled(scale)
        target = np.moveaxis(view.target, 0, -1)
        rows, columns = view.camera.height // camera.height, view.camera.width // camera.width
        if (rows * camera.height, columns * camera.width) == (view.camera.height, view.camera.width):
            small = target.reshape(camera.height, rows, camera.width, columns, -1).mean(axis=(1, 3))
        else:
            small = area_average(target.astype(np.float64), (camera.width, camera.height)).astype(np.float32)
        planes = np.ascontiguousarray(np.moveaxis(small, -1, 0))
        return self._view(view.name, CameraArrays.of(camera), planes, view.exposure)

    def retouched(self, view: TrainingView, target: Array) -> TrainingView:
        """The view with other planes [C, H, W] of the same size."""
        return self._view(view.name, view.camera, target, view.exposure)

    def cropped(self, view: TrainingView, left: int, top: int, right: int, bottom: int) -> TrainingView:
        """The part of a view in a rectangle of whole pixels, ``right`` and ``bottom`` excluded."""
        lens = view.camera.lens.copy()
        lens[2:] = lens[2] - left, lens[3] - top, right - left, bottom - top
        camera = view.camera._replace(lens=lens, width=right - left, height=bottom - top)
        target = np.ascontiguousarray(view.target[:, top:bottom, left:right])
        return self._view(view.name, camera, target, view.exposure)

    def _view(self, name: str, camera: CameraArrays, target: Array, exposure: Array) -> TrainingView:
        return TrainingView(name, camera, target, exposure, self.scratch(*target.shape))


def pictures_of(
    frame: Frame, name: str, size: tuple[int, int], use_masks: bool = True
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """A camera's picture [H, W, 3] and mask [H, W] (None where there is none), of the size (width, height).

    Raises:
        ValueError: they are of another size.
    """
    width, height = size
    image = frame.images[name]
    mask = frame.masks[name] if use_masks and name in frame.masks else None
    for what, array, shape in (("picture", image, (height, width, 3)), ("mask", mask, (height, width))):
        if array is not None and array.shape != shape:
            raise ValueError(
                f"frame {frame.index}, camera {name!r}: {what} is {'x'.join(map(str, array.shape[1::-1]))} "
                f"(array {array.shape}), the rig says {width}x{height} (array {shape})"
            )
    return image, mask


def view_order(count: int, iterations: int, rng: np.random.Generator) -> Sequence[int]:
    """The view that each iteration trains: a new random order whenever all have been used."""
    rounds = -(-iterations // count)
    order = np.concatenate([rng.permutation(count) for _ in range(rounds)])[:iterations]
    return [int(index) for index in order]


def no_lap(stage: str) -> None:
    """Nobody takes the time."""


class PictureLoss:
    """The image and mask loss of a set of Gaussians in one view, with gradients.

    Args:
        background: RGB behind everything.
        image_weight, mask_weight: weights of the two terms.
        mask_moves: whether the mask loss pulls at positions and shapes, or at the labels alone: masks have hard edges,
            and a silhouette fitted to them is not the one that fits the pictures.
    """

    def __init__(
        self,
        factory: ViewFactory,
        background: tuple[float, float, float],
        image_weight: float,
        mask_weight: float,
        mask_moves: bool = True,
        limits: Limits = DEFAULT,
    ) -> None:
        self.rasterizer = CpuRasterizer(limits)
        self._factory = factory
        self._detached = -1 if mask_moves else LABEL
        self._background = np.array([*background, 0.0], np.float32)
        self._weights = np.array([image_weight / 3] * 3 + [mask_weight], np.float32)
        self.exposure_gradient = np.zeros((CHANNELS, 2), np.float32)
        self.image_part = 0.0
        self.mask_part = 0.0
        self.psnr = 0.0

    def begin(self, previous: Gaussians) -> None:
        """Takes the state that a frame starts from; here nothing hangs on it."""

    def apart(self, factory: ViewFactory) -> PictureLoss:
        """The image loss with the same background and limits, and buffers of its own: for views of other sizes."""
        red, green, blue, _ = self._background.tolist()
        limits = Limits(*self.rasterizer.limits.tolist())
        return PictureLoss(factory, (red, green, blue), 1.0, 0.0, limits=limits)

    def evaluate(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        lap: Callable[[str], None] = no_lap,
    ) -> Gradients:
        """Render the view, set ``image_part``, ``mask_part`` and ``psnr`` (dB), and return the gradients.

        The gradients are buffers, valid until the next call.

        Args:
            means, factors, opacities, features: [N, 3], [N, 3, 3], [N], [N, 4] (RGB, label), float32.
            lap: told when each stage is done.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        lap("render")
        g_image, g_alpha = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)
        lap("picture loss")
        gradients = self.rasterizer.backward(g_image, g_alpha, self._detached)
        lap("render backward")
        return gradients

    def render(self, state: Gaussians, features: Array, view: TrainingView, depth_channel: int = -1) -> Picture:
        """The view without a comparison; see ``CpuRasterizer.forward``."""
        given = (state.means, state.factors, state.opacities, features, view.camera, self._background)
        return self.rasterizer.forward(*given, depth_channel)

    def shown(self, view: TrainingView) -> Picture:
        """The view's whole picture as ``evaluate`` rendered it last; valid until anything else is rendered."""
        return self.rasterizer.picture

    def measure(self, means: Array, factors: Array, opacities: Array, features: Array, view: TrainingView) -> None:
        """Render the view and set ``image_part``, ``mask_part`` and ``psnr``, without gradients; see ``evaluate``."""
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        g_image, _ = self.rasterizer.gradient_buffers()
        self._compare(view, g_image)

    def _compare(self, view: TrainingView, g_image: Array) -> None:
        """Fill the losses of what was rendered, and its gradient."""
        channels, height, width = view.target.shape
        rows = np.empty((channels, height, 2), np.float32)
        g_exposure = np.empty((channels, height, 2), np.float32)
        image_loss.image_loss(
            self.rasterizer.planes, view.exposure, view.target, *view.moments, self._weights[:channels],
            height * width, self._factory.scratch(channels, height, width), image_loss.EVERYWHERE, g_image, rows,
            g_exposure,
        )  # fmt: skip
        g_image[channels:] = 0
        sums = rows.sum(axis=1, dtype=np.float64)
        self.image_part, self.mask_part = float(sums[:3, 0].sum()), float(sums[3:, 0].sum())
        self.psnr = 10 * log10(3 * height * width / max(float(sums[:3, 1].sum()), SMALLEST_SQUARE))
        self.exposure_gradient[:channels] = g_exposure.sum(axis=1)

    def colour_shift(self, view: TrainingView) -> tuple[float, float, float]:
        """Mean of the view's picture minus mean of what was rendered for it last, exposure included, RGB in 0…1."""
        height, width = view.camera.height, view.camera.width
        rendered = means(self.rasterizer.planes[:3, :height, :width])
        shown = view.exposure[:3, 0] * rendered + view.exposure[:3, 1]
        red, green, blue = (view.mean - shown).tolist()
        return red, green, blue

    def residuals(
        self,
        means: Array,
        factors: Array,
        opacities: Array,
        features: Array,
        view: TrainingView,
        learnt: NDArray[np.uint8],
        most: float,
    ) -> tuple[Array, Array]:
        """Sums over the pixels of what the view's picture has more than is rendered, and of 1, by blending weight.

        Args:
            learnt: [N] 1 for the Gaussians that the sums are wanted of. most: RGB in 0…1 that a pixel counts as more.

        Returns: [N, 3] RGB in pixels' worth, without the camera's exposure, and [N] pixels' worth.
        """
        drawing = Drawing(np.full(prod(view.camera.tiles), 2**64 - 1, np.uint64), learnt)
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background, drawing=drawing)
        return self._lacking(view, most)

    def _lacking(self, view: TrainingView, most: float) -> tuple[Array, Array]:
        """The sums of ``residuals`` over what was drawn."""
        height, width = view.camera.height, view.camera.width
        g_image, _ = self.rasterizer.gradient_buffers()
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        here = (slice(None, 3), slice(height), slice(width))
        g_image[here] = np.clip((view.target[:3] - offset) / gain - self.rasterizer.planes[here], -most, most)
        g_image[LABEL, :height, :width] = 1
        found = self.rasterizer.feature_gradients(g_image)
        return found[:, :3].copy(), found[:, LABEL].copy()

    def coverage(
        self, means: Array, factors: Array, opacities: Array, features: Array, view: TrainingView, *pixels: Array
    ) -> Array:
        """[1 + P, N] pixels' worth of blending weight of each Gaussian in a view; the gradients of channels' sums.

        Args:
            pixels: P times [H, W], up to three, what each pixel counts; before these come all, each counted once.
        """
        self.rasterizer.forward(means, factors, opacities, features, view.camera, self._background)
        g_image, _ = self.rasterizer.gradient_buffers()
        g_image[:] = 0
        for plane, count in zip(g_image, (1.0, *pixels), strict=False):
            plane[: view.camera.height, : view.camera.width] = count
        weights = self.rasterizer.feature_gradients(g_image).T[: 1 + len(pixels)].copy()
        g_image[:] = 0
        return weights
