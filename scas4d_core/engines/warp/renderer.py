"""GPU renderer, which renders states with the kernels of the Warp engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import (
    BLOCK,
    CHANNELS,
    PRIOR_PIXELS,
    Comparison,
    Neighbourhoods,
    Picture,
    extrapolated,
    psnr_of,
)
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView
from scas4d_core.engines.warp.copies import as_numbers, copies_on, features_on, structures_on
from scas4d_core.engines.warp.downloads import Downloads
from scas4d_core.engines.warp.gloss import features_seen
from scas4d_core.engines.warp.lanes import load
from scas4d_core.engines.warp.layout import COLUMNS, IMAGE_LOSS, PAIRS, SHIFT, SQUARES, Camera, camera_of
from scas4d_core.engines.warp.nearest import nearest
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.projection import RECORD
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.gaussians import Gaussians
from scas4d_core.guards import FEATURE_CEILING

wp.set_module_options({"enable_backward": False})

Array = NDArray[np.float32]
PADDING = 32
"""Tile size in pixels. ``reached`` pads images to a multiple of this size."""
PIXELS_AT_ONCE = 2**21
"""Maximum number of pixels that ``render_each`` downloads at once, but at least one picture. A pixel takes 20 bytes,
so the pictures take at most 42 MB, or as much as one larger picture."""


@wp.kernel
def set_depth(
    cameras: wp.array[Camera],
    means: wp.array[wp.vec3],
    channel: wp.int32,
    features: wp.array[wp.vec4],
    changed: wp.array[wp.vec4],
) -> None:
    """Copies features and replaces one channel with the depth of each mean, with one thread per Gaussian.

    Args:
        cameras: [1] camera.
        means, features: [N] means and features.
        channel: channel to replace.
        changed: [N] output.
    """
    i = wp.tid()
    feature = features[i]
    feature[channel] = (cameras[0].rotation * means[i] + cameras[0].translation)[2]
    changed[i] = feature


@wp.kernel
def weigh_residuals(
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    exposures: wp.array2d[wp.vec2],
    targets: wp.array4d[wp.float32],
    planes: wp.array3d[wp.float32],
    most: wp.float32,
    residuals: wp.array3d[wp.float32],
) -> None:
    """Computes the residuals of a rendering before exposure, with one thread per pixel and channel.

    Args:
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        exposures: [views, 4] gain and offset of each channel.
        targets: [views, 4, rows, columns] training images and masks.
        planes: [5, rows, columns] rendering.
        most: magnitude to which residuals are clipped.
        residuals: [4, rows, columns] output, RGB residuals and a plane of ones.
    """
    channel, y, x = wp.tid()
    camera = cameras[view[0]]
    if x < camera.width and y < camera.height:
        value = wp.float32(1.0)
        if channel < 3:
            exposure = exposures[view[0], channel]
            value = (targets[view[0], channel, y, x] - exposure[1]) / exposure[0] - planes[channel, y, x]
            value = wp.clamp(value, -most, most)
        residuals[channel, y, x] = value


@wp.kernel
def add_sums(records: wp.array[wp.vec4], sums: wp.array[wp.vec4]) -> None:
    """Adds the feature gradients of the gradient records to sums [N], with one thread per Gaussian."""
    i = wp.tid()
    r1 = load(records, RECORD * i + 1)
    r2 = load(records, RECORD * i + 2)
    sums[i] = sums[i] + wp.vec4(r1[2], r1[3], r2[0], r2[1])


@wp.kernel
def take_colour_step(
    learnt: wp.array[wp.uint8],
    sums: wp.array[wp.vec4],
    prior: wp.float32,
    features: wp.array[wp.vec4],
) -> None:
    """Adds the weighted mean residual to the colours of selected Gaussians, with one thread per Gaussian.

    Args:
        learnt: [N] mask of the selected Gaussians.
        sums: [N] weighted sums of the RGB residuals, and sum of the weights.
        prior: number added to the sum of the weights.
        features: [N] colours and labels, changed in place.
    """
    i = wp.tid()
    if learnt[i] != wp.uint8(0):
        total = sums[i]
        weight = prior + total[3]
        features[i] = features[i] + wp.vec4(total[0] / weight, total[1] / weight, total[2] / weight, 0.0)


@wp.kernel
def extrapolate_numbers(
    share: wp.float32,
    before: wp.array2d[wp.float32],
    after: wp.array2d[wp.float32],
    moved: wp.array2d[wp.float32],
) -> None:
    """Adds a fraction of the change between two [N, C] arrays, with one thread per number."""
    i, k = wp.tid()
    moved[i, k] = after[i, k] + share * (after[i, k] - before[i, k])


@wp.kernel
def round_to_levels(
    planes: wp.array3d[wp.float32], first: wp.int32, sign: wp.float32, offset: wp.float32, levels: wp.array3d[wp.uint8]
) -> None:
    """Rounds planes to 8 bits like ``renderer.levels``, with one thread per pixel.

    Args:
        planes: [5, rows, columns] rendering.
        first: index of the first plane to round.
        sign, offset: factor and offset of the values, 1 and 0, or −1 and 1 to invert them.
        levels: [H, W, C] output.
    """
    y, x = wp.tid()
    for c in range(levels.shape[2]):
        value = wp.clamp(offset + sign * planes[first + c, y, x], 0.0, 1.0)
        levels[y, x, c] = wp.uint8(wp.rint(255.0 * value))


@wp.kernel
def turn_normals(
    near: wp.array2d[wp.int32],
    before: wp.array[wp.vec3],
    after: wp.array[wp.vec3],
    gloss: wp.array2d[wp.float32],
    turned: wp.array2d[wp.float32],
) -> None:
    """Rotates normals with their neighbourhoods in float64, with one thread per Gaussian with gloss.

    Args:
        near: [G, k] rows of the Gaussians in each neighbourhood.
        before, after: [N] means of two states.
        gloss: [G, 3] normal of each Gaussian, scaled by its gloss strength.
        turned: [G, 3] output.
    """
    i = wp.tid()
    count = near.shape[1]
    mean_before = wp.vec3d()
    mean_after = wp.vec3d()
    for k in range(count):
        mean_before += wp.vec3d(before[near[i, k]]) / wp.float64(count)
        mean_after += wp.vec3d(after[near[i, k]]) / wp.float64(count)
    spread = wp.mat33d()
    for k in range(count):
        spread += wp.outer(wp.vec3d(after[near[i, k]]) - mean_after, wp.vec3d(before[near[i, k]]) - mean_before)
    if not wp.isfinite(wp.ddot(spread, spread)):
        spread = wp.identity(n=3, dtype=wp.float64)
    left = wp.mat33d()
    sizes = wp.vec3d()
    right = wp.mat33d()
    wp.svd3(spread, left, sizes, right)  # both matrices are rotations
    own = wp.vec3d(wp.vec3(gloss[i, 0], gloss[i, 1], gloss[i, 2]))
    normal = left * (wp.transpose(right) * own)
    for c in range(3):
        turned[i, c] = wp.float32(normal[c])


class WarpRenderer:
    """The ``Renderer`` implementation in NVIDIA Warp. Calls that return pixels or numbers wait for the device.

    The most recently used states stay on the device (``DeviceCopies``), as do the images that an engine has loaded.

    Args:
        background: background colour, RGB in [0, 1].
        limits: rasterizer constants.
        device: Warp device, such as "cpu" or "cuda:0".
        image_weight: weight of the image loss in ``compare``.

    Attributes:
        device, limits, background: same as the arguments.
    """

    def __init__(
        self,
        background: tuple[float, float, float],
        limits: Limits = DEFAULT,
        device: str = "cuda:0",
        image_weight: float = 1.0,
    ) -> None:
        self.device, self.limits, self.background = device, limits, background
        self._background = np.array([*background, 0.0], np.float32)
        self._loss = PictureLoss(device, image_weight, 0.0)
        self._copies = copies_on(device)
        self._downloads = Downloads(device)
        self._rasterizer = Rasterizer(device, 0, limits)
        self._first = wp.zeros(1, dtype=wp.int32, device=device)
        self._behind = wp.zeros(1, dtype=wp.vec4, device=device)
        self._log, self._records = self._make_log(1)
        self._near: tuple[Neighbourhoods, wp.array] | tuple[None, None] = None, None

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """See ``Renderer.render``."""
        cameras = self._camera(camera)
        groups, sound = self._features(state, cameras, features)
        if depth_channel >= 0:
            place, channel = divmod(depth_channel, CHANNELS)
            groups[place] = self._with_depth(state, cameras, groups[place], channel)
        if background is None:
            background = np.zeros(CHANNELS * len(groups), np.float32)
            background[:CHANNELS] = self._background

        def draw() -> list[wp.array]:
            self._project(state, camera, cameras, groups, sound)
            backgrounds = background.reshape(len(groups), CHANNELS)
            return [self._drawn(camera, cameras, *each) for each in zip(groups, backgrounds, strict=True)]

        _, *drawn = self._read(draw)
        if len(drawn) == 1:
            return Picture(drawn[0][:CHANNELS], drawn[0][CHANNELS])
        return Picture(np.concatenate([planes[:CHANNELS] for planes in drawn]), drawn[0][CHANNELS])

    def render_each(
        self, shots: Sequence[tuple[Gaussians, CameraArrays]], *, depth_channel: int = -1
    ) -> Iterator[Picture]:
        """See ``Renderer.render_each``."""
        if not shots:
            return
        columns, rows = largest([camera for _, camera in shots])
        count = max(1, PIXELS_AT_ONCE // (columns * rows))
        for first in range(0, len(shots), count):
            for planes in self._render_at_once(shots[first : first + count], depth_channel):
                yield Picture(planes[:CHANNELS], planes[CHANNELS])

    def _render_at_once(
        self, shots: Sequence[tuple[Gaussians, CameraArrays]], depth_channel: int
    ) -> list[NDArray[Any]]:
        """Returns the planes [5, H, W] of each picture, with one wait for the device."""
        self._make_room(shots[0][0], *largest([camera for _, camera in shots]))

        def draw() -> list[wp.array]:
            pictures = []
            for record, (state, camera) in enumerate(shots):
                cameras = self._camera(camera)
                features = features_seen(self._copies, state, cameras)
                if depth_channel >= 0:
                    features = self._with_depth(state, cameras, features, depth_channel)
                self._project(state, camera, cameras, [features], record=record)
                pictures.append(self._drawn(camera, cameras, features, self._background))
            return pictures

        return self._read(draw, len(shots))[1:]

    def render_levels(
        self, state: Gaussians, camera: CameraArrays, background: Array, *, opacity: bool
    ) -> NDArray[np.uint8]:
        """See ``Renderer.render_levels``. Only the 8-bit values are downloaded."""
        cameras = self._camera(camera)
        features = features_seen(self._copies, state, cameras)
        shape = camera.height, camera.width
        levels = wp.empty((*shape, 1 if opacity else LABEL), dtype=wp.uint8, device=self.device)
        chosen = (CHANNELS, -1.0, 1.0) if opacity else (0, 1.0, 0.0)

        def draw() -> list[wp.array]:
            self._project(state, camera, cameras, [features])
            self._draw(cameras, features, background)
            wp.launch(round_to_levels, shape, [self._rasterizer.planes, *chosen, levels], device=self.device)
            return [levels]

        pixels: NDArray[np.uint8] = self._read(draw)[1]
        return pixels[..., 0] if opacity else pixels

    def compare(self, state: Gaussians, views: Sequence[TrainingView]) -> list[Comparison]:
        """See ``Renderer.compare``. The host waits only once, if an engine has loaded the images."""
        if not views:
            return []
        self._make_room(state, *largest([view.camera for view in views]))

        def draw() -> list[wp.array]:
            for record, view in enumerate(views):
                self._render_view(state, view, record=record)
                row = self._records[record : record + 1]
                self._loss.measure(self._first, row, self._rasterizer, self._behind, self._log)
            return []

        compared = []
        for log, view in zip(self._read(draw, len(views))[0].astype(float), views, strict=True):
            red, green, blue = log[SHIFT : SHIFT + 3].tolist()
            psnr = psnr_of(float(log[SQUARES]), view.camera.width * view.camera.height)
            compared.append(Comparison(psnr, float(log[IMAGE_LOSS]), (red, green, blue)))
        return compared

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """See ``Renderer.gather``."""
        cameras, features = self._camera(camera), wp.zeros(len(state), dtype=wp.vec4, device=self.device)
        given = wp.array(np.ascontiguousarray(planes, np.float32), dtype=wp.float32, ndim=3, device=self.device)

        def draw() -> list[wp.array]:
            self._project(state, camera, cameras, [features])
            self._draw(cameras, features, np.zeros(CHANNELS, np.float32))
            weights = self._rasterizer.g_planes
            weights.zero_()
            wp.copy(weights[: len(planes), : camera.height, : camera.width], given)
            # The sums are the feature gradients of a sum of weighted pixels.
            self._rasterizer.carry_back(cameras, self._first, features)
            sums = wp.zeros(len(state), dtype=wp.vec4, device=self.device)
            wp.launch(add_sums, len(state), [self._rasterizer.records, sums], device=self.device)
            return [sums]

        gathered: Array = self._read(draw)[1]
        return gathered[:, : len(planes)]

    def step_colours(
        self, state: Gaussians, subsets: Sequence[Sequence[TrainingView]], learnt: NDArray[np.uint8], most: float
    ) -> Gaussians:
        """See ``Renderer.step_colours``. The host waits only once, if an engine has loaded the images."""
        if not subsets:
            return state
        chosen = self._copies.of(learnt, wp.uint8)
        stepped = wp.empty_like(features_on(self._copies, state))
        views = [view for subset in subsets for view in subset]
        self._make_room(state, *largest([view.camera for view in views]))

        def draw() -> list[wp.array]:
            wp.copy(stepped, features_on(self._copies, state))
            record = 0
            for subset in subsets:
                sums = wp.zeros(len(state), dtype=wp.vec4, device=self.device)
                for view in subset:
                    self._add_residuals(state, view, stepped, most, sums, record)
                    record += 1
                inputs = [chosen, sums, PRIOR_PIXELS, stepped]
                wp.launch(take_colour_step, len(state), inputs, device=self.device)
            return [stepped]

        features = self._read(draw, len(views))[1]
        state = state.replace(colours=np.ascontiguousarray(features[:, :LABEL]))
        self._copies.store(stepped, state.colours, state.foreground)
        return state

    def _add_residuals(
        self, state: Gaussians, view: TrainingView, plain: wp.array, most: float, sums: wp.array, record: int
    ) -> None:
        """Adds the weighted residuals of a view to [N] vec4 sums; ``plain`` are the features without gloss."""
        loss, features = self._loss, self._render_view(state, view, plain, record)
        rasterizer = self._rasterizer
        target = [loss.cameras, self._first, loss.exposures, loss.targets]
        inputs = [*target, rasterizer.planes, most, rasterizer.g_planes]
        wp.launch(weigh_residuals, rasterizer.g_planes.shape, inputs, device=self.device)
        rasterizer.carry_back(loss.cameras, self._first, features)
        wp.launch(add_sums, len(state), [rasterizer.records, sums], device=self.device)

    def extrapolate(self, before: Gaussians, after: Gaussians, share: float) -> Gaussians:
        """See ``Renderer.extrapolate``."""
        state = extrapolated(before, after, share)
        for name, dtype in (("means", wp.vec3), ("factors", wp.mat33)):
            first, last = (self._copies.of(getattr(each, name), dtype) for each in (before, after))
            moved = wp.empty_like(last)
            inputs = [as_numbers(array) for array in (first, last)]
            wp.launch(extrapolate_numbers, inputs[0].shape, [share, *inputs, as_numbers(moved)], device=self.device)
            self._copies.store(moved, getattr(state, name))
        return state

    def turn_normals(self, before: Gaussians, after: Gaussians, near: Neighbourhoods) -> Gaussians:
        """See ``Renderer.turn_normals``."""
        assert after.gloss is not None
        if near is not self._near[0]:
            roots = structures_on(self.device).of(near.means, wp.vec3)
            self._near = near, nearest(roots, near.count, own=True)[0]
        means = (self._copies.of(state.means, wp.vec3) for state in (before, after))
        gloss = self._copies.of(after.gloss, wp.float32)
        turned = wp.empty_like(gloss)
        wp.launch(turn_normals, len(gloss), [self._near[1], *means, gloss, turned], device=self.device)
        normals = self._downloads.read(turned)[0]
        self._copies.store(turned, normals)
        return after.replace(gloss=normals)

    def reached(self, state: Gaussians, cameras: Sequence[CameraArrays]) -> list[NDArray[np.bool_]]:
        """See ``Renderer.reached``. The host waits only once."""
        if not cameras:
            return []
        features = features_on(self._copies, state)
        self._make_room(state, *largest(cameras))

        def draw() -> list[wp.array]:
            marked = []
            for record, camera in enumerate(cameras):
                arrays = self._camera(camera)
                self._project(state, camera, arrays, [features], record=record)
                shape = (-(-size // PADDING) * PADDING // BLOCK for size in (camera.height, camera.width))
                marks = wp.zeros(tuple(shape), dtype=wp.int32, device=self.device)
                self._rasterizer.mark(arrays, BLOCK, features, marks)
                marked.append(marks)
            return marked

        return [marks != 0 for marks in self._read(draw, len(cameras))[1:]]

    def pairs_per_pixel(
        self, state: Gaussians, cameras: Sequence[CameraArrays], every: int = 1
    ) -> list[NDArray[np.int32]]:
        """See ``Renderer.pairs_per_pixel``. The host waits only once."""
        shapes = [(-(-camera.height // every), -(-camera.width // every)) for camera in cameras]
        counts = [wp.empty(shape, dtype=wp.int32, device=self.device) for shape in shapes]
        self._make_room(state, *largest(cameras))

        def draw() -> list[wp.array]:
            for record, (camera, pairs) in enumerate(zip(cameras, counts, strict=True)):
                features = [features_on(self._copies, state)]
                self._project(state, camera, self._camera(camera), features, record=record)
                self._rasterizer.count_pairs(every, pairs)
            return counts

        return self._read(draw, len(cameras))[1:]

    def _camera(self, camera: CameraArrays) -> wp.array:
        return wp.array([camera_of(camera)], dtype=Camera, device=self.device)

    def _features(
        self, state: Gaussians, cameras: wp.array, features: Array | None
    ) -> tuple[list[wp.array], NDArray[np.bool_] | None]:
        """Returns the features in groups of four channels, [N] vec4 each, and a [N] mask of valid features.

        The mask is None if there is only one group, because the projection then culls Gaussians with invalid features.
        """
        if features is None:
            return [features_seen(self._copies, state, cameras)], None
        features = np.asarray(features, np.float32)
        groups = [features[:, first : first + CHANNELS] for first in range(0, features.shape[1], CHANNELS)]
        uploaded = [wp.array(np.ascontiguousarray(group), dtype=wp.vec4, device=self.device) for group in groups]
        if len(uploaded) == 1:
            return uploaded, None
        return uploaded, np.asarray((np.abs(features) <= FEATURE_CEILING).all(axis=1))

    def _with_depth(self, state: Gaussians, cameras: wp.array, features: wp.array, channel: int) -> wp.array:
        """Returns a copy of [N] vec4 features in which one channel is the depth of each mean."""
        changed = wp.empty_like(features)
        inputs = [cameras, self._copies.of(state.means, wp.vec3), channel, features, changed]
        wp.launch(set_depth, len(state), inputs, device=self.device)
        return changed

    def _drawn(self, camera: CameraArrays, cameras: wp.array, features: wp.array, background: Array) -> wp.array:
        """Returns a copy of the planes [5, H, W] of features of the projected Gaussians; see ``_draw``."""
        self._draw(cameras, features, background)
        return wp.clone(self._rasterizer.planes[:, : camera.height, : camera.width])

    def _make_log(self, renderings: int) -> tuple[wp.array, wp.array]:
        """Returns a log with one row per rendering, [renderings, COLUMNS], and the indices of its rows."""
        log = wp.zeros((renderings, COLUMNS), dtype=wp.float32, device=self.device)
        return log, wp.array(np.arange(renderings), dtype=wp.int32, device=self.device)

    def _make_room(self, state: Gaussians, columns: int, rows: int) -> None:
        """Makes a rasterizer for the state and image size, unless the last one holds them."""
        if len(state) != self._rasterizer.count or not self._rasterizer.holds(columns, rows):
            self._rasterizer = Rasterizer(self.device, len(state), self.limits)
            self._rasterizer.resize(columns, rows)

    def _read(self, draw: Callable[[], Sequence[wp.array]], renderings: int = 1) -> list[NDArray[Any]]:
        """Returns the log, and the arrays that ``draw`` computes, with one wait for the device.

        If tile lists were too small, they are enlarged, and ``draw`` is called again.

        Args:
            draw: function that enqueues the work, and logs each rendering in a row of its own. It must reset everything
                that it accumulates, and must not need a larger rasterizer after its first rendering (``_make_room``).
            renderings: number of rows of the log.

        Returns:
            The log [renderings, COLUMNS], followed by a copy of each array.
        """
        if len(self._log) != renderings:
            self._log, self._records = self._make_log(renderings)
        while True:
            arrays = draw()
            log, *values = self._downloads.read(self._log, *arrays)
            if not self._rasterizer.grow(log[:, PAIRS].max()):
                return [log, *values]

    def _project(
        self,
        state: Gaussians,
        camera: CameraArrays,
        cameras: wp.array,
        groups: Sequence[wp.array],
        sound: NDArray[np.bool_] | None = None,
        record: int = 0,
    ) -> None:
        """Projects a state and builds its tile lists; see ``_features`` for ``groups`` and ``sound``.

        ``_read`` finds out whether the lists were large enough, from the given row of the log.
        """
        self._make_room(state, camera.width, camera.height)
        copies, features = self._copies, groups[0]
        opacities = copies.of(state.opacities, wp.float32)
        if sound is not None and not sound.all():  # projection can only check one group
            opacities = wp.array(np.where(sound, state.opacities, np.float32(0)), dtype=wp.float32, device=self.device)
        shapes = copies.of(state.means, wp.vec3), copies.of(state.factors, wp.mat33), opacities
        row = self._records[record : record + 1]
        self._rasterizer.project(cameras, self._first, *shapes, features, row, self._log)

    def _draw(self, cameras: wp.array, features: wp.array, background: Array) -> None:
        """Rasterizes features [N] vec4 of the projected Gaussians."""
        self._behind.assign(background[None])
        self._rasterizer.draw(cameras, self._first, features, self._behind)

    def _render_view(
        self, state: Gaussians, view: TrainingView, plain: wp.array | None = None, record: int = 0
    ) -> wp.array:
        """Renders a state from a view's camera, loads the view, and returns the features that the camera sees."""
        cameras = self._camera(view.camera)
        features = features_seen(self._copies, state, cameras, plain)
        self._project(state, view.camera, cameras, [features], record=record)
        self._draw(cameras, features, self._background)
        self._loss.load([view])
        return features


def largest(cameras: Sequence[CameraArrays]) -> tuple[int, int]:
    """Returns the largest width and height of the cameras' images."""
    return max(camera.width for camera in cameras), max(camera.height for camera in cameras)
