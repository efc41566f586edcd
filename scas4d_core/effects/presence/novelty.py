"""Novelty maps: pixels with objects missing from the state, and pixels in which the state shows absent objects.

With masks, a pixel is new if it is foreground in the mask but not in the rendering. Without masks, a pixel is new if
the image differs from the rendering of the static scene. Motion that was not tracked causes new and stale pixels in
about equal numbers. Therefore, only a surplus of new over stale pixels indicates a new object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, binary_propagation, uniform_filter

from scas4d_core.frame_outcome import Candidate

if TYPE_CHECKING:
    from scas4d_core.cameras import Camera, Rig
    from scas4d_core.effects.evidence import FrameObservation
    from scas4d_core.engines.engine import Thinned
    from scas4d_core.engines.renderer import Picture, Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.result import UpdateTrace

Bool = NDArray[np.bool_]
Array = NDArray[np.float32]

THERE, ABSENT = 0.5, 0.3
"""Rendered label above which a pixel shows a moving Gaussian, and label below which it shows none."""
RIM = 3
"""Minimum width of a region, in pixels. Narrower regions are outlines that are off by a pixel."""
BARE = 0.5
"""Transmittance above which the state is empty at a pixel."""
DIFFERENT, TIMES_USUAL = 0.1, 3.0
"""Minimum channel difference, [0, 1], averaged over a square of ``RIM`` × ``RIM`` pixels. Without masks, the second
value is the minimum ratio of this difference to its median over the image."""


@dataclass(frozen=True, eq=False)
class Novelty:
    """Novelty map of a camera.

    Attributes:
        view: training view of the frame.
        camera: camera in the internal world.
        image: [H, W, 3] image in [0, 1], with the camera's exposure removed.
        new: [H, W] mask of pixels in which the image shows something missing from the state.
        stale: [H, W] mask of pixels in which the state shows something that the image does not show.
        covered: [H, W] mask of pixels in which the state shows a moving object, which may hide something new.
        bare: [H, W] mask of pixels in which the state is empty but the image shows static background.
        behind: [H, W] mask of pixels in which image and state show no moving object, as far as can be determined.
        error: [H, W] squared difference between image and rendering, averaged over channels.
    """

    view: TrainingView
    camera: Camera
    image: Array
    new: Bool
    stale: Bool
    covered: Bool
    bare: Bool
    behind: Bool
    error: Array

    @property
    def surplus(self) -> int:
        """Number of new pixels minus number of stale pixels."""
        return int(self.new.sum()) - int(self.stale.sum())


class CoarseNovelty(NamedTuple):
    """Coarse novelty estimate from a subsampled rendering of the update, which avoids rendering again.

    Attributes:
        view: training view of the frame.
        new, bare: shares of new and bare pixels; see ``Novelty``. Regions appear smaller, because outlines are removed.
    """

    view: TrainingView
    new: float
    bare: float


SCREENED_CAMERAS = 6
"""Maximum number of cameras that are screened in each frame before all are checked. If the update has left no
renderings, different cameras are screened in each frame."""
COARSE_SHARE = 0.5
"""Share of the required pixels that a coarse estimate must find. On the captures, estimates find 0.6 to 0.9 of relevant
regions, and 0.2 to 0.6 of irrelevant outlines."""

_novelty_cache: WeakKeyDictionary[Gaussians, dict[str, Novelty]] = WeakKeyDictionary()
"""Novelty maps of each state, cached because several effects use them."""
_coarse_cache: WeakKeyDictionary[UpdateTrace, list[CoarseNovelty]] = WeakKeyDictionary()
"""Coarse estimates of each update."""


def screen_novelty(seen: FrameObservation, least: int, new: float = 0.0, bare: float = 0.0) -> list[Novelty]:
    """Returns novelty maps of the cameras that may see something new or bare, according to coarse estimates.

    The list is empty if there are fewer than ``least`` such cameras. Without enough coarse estimates, the list
    contains a few cameras that vary between frames.

    Args:
        seen: the learnt frame.
        least: minimum number of cameras that may see something new or bare.
        new, bare: minimum shares of new and of bare pixels in each camera's image.
    """
    glimpses = _coarse_novelties(seen) if seen.result.trace.kept is Candidate.END else []
    if len(glimpses) >= min(SCREENED_CAMERAS, len(seen.views)) > 0:  # with fewer, the update ended earlier than planned
        seem = [one.view for one in glimpses if one.new >= COARSE_SHARE * new and one.bare >= COARSE_SHARE * bare]
        return novelty_of_views(seen, seem[: max(SCREENED_CAMERAS, least)]) if len(seem) >= least else []
    count = len(seen.views)
    looked_at = min(SCREENED_CAMERAS, count)
    return novelty_of_views(seen, [seen.views[(seen.index + count * k // looked_at) % count] for k in range(looked_at)])


def _coarse_novelties(seen: FrameObservation) -> list[CoarseNovelty]:
    """Returns the coarse estimates of the cameras that the update rendered last."""
    trace = seen.result.trace
    if trace not in _coarse_cache:
        _coarse_cache[trace] = [
            _coarse_novelty(view, trace.shown[view.name]) for view in seen.views if view.name in trace.shown
        ]
    return _coarse_cache[trace]


def _coarse_novelty(view: TrainingView, thinned: Thinned) -> CoarseNovelty:
    """Returns a coarse estimate from a view and its rendering. All four pixels of a 2 × 2 block must agree."""
    every, shown = thinned
    target = view.target[:, ::every, ::every]
    difference = sum(_corners(np.abs(target[:3] - view.exposed(shown[:3])).mean(axis=0))) / 4
    label, transmittance = shown[3], shown[4]
    if len(target) > 3:
        new, static = (target[3] > 0.5) & (label < ABSENT), (target[3] <= 0.5) & (label < ABSENT)
        new_squares = _all_corners(new)
    else:
        static = label < ABSENT
        new_squares = _all_corners(label < THERE) & (
            difference > max(DIFFERENT, TIMES_USUAL * float(np.median(difference)))
        )
    bare = _all_corners(static & (transmittance > BARE)) & (difference > DIFFERENT)
    return CoarseNovelty(view, float(new_squares.mean()), float(bare.mean()))


def _corners(plane: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Returns the four [h − 1, w − 1] corner planes of all 2 × 2 blocks."""
    return plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]


def _all_corners(plane: Bool) -> Bool:
    one, two, three, four = _corners(plane)
    everywhere: Bool = one & two & three & four
    return everywhere


def novelty_of_views(seen: FrameObservation, views: Sequence[TrainingView]) -> list[Novelty]:
    """Returns the novelty map of each view, rendered with the colours of the previous frame.

    In the current state, static colours may have absorbed a new object.
    """
    state = seen.result.gaussians
    known = _novelty_cache.setdefault(state, {})
    missing = [view for view in views if view.name not in known or known[view.name].view is not view]
    colours = seen.before.colours
    if len(state) > len(colours):
        colours = np.concatenate([colours, state.colours[len(colours) :]])
    new_things = measure_novelty(state, colours, missing, seen.rig, seen.renderer)
    known.update({view.name: one for view, one in zip(missing, new_things, strict=True)})
    return [known[view.name] for view in views]


def measure_novelty(
    state: Gaussians,
    colours: Array,
    views: Sequence[TrainingView],
    rig: Rig | Mapping[str, Camera],
    renderer: Renderer,
) -> list[Novelty]:
    """Returns the novelty map of each view relative to a state.

    Args:
        state: state Θ_t, updated to the frame.
        colours: [N, 3] RGB to render, usually from the previous frame, whose colours have not absorbed new objects.
        views: training views of the frame.
        rig: cameras in the internal world.
        renderer: renderer for the state.
    """
    shown = state.replace(colours=colours)
    pictures = renderer.render_each([(shown, view.camera) for view in views])
    return [_novelty(view, rig[view.name], picture) for view, picture in zip(views, pictures, strict=True)]


def _novelty(view: TrainingView, camera: Camera, picture: Picture) -> Novelty:
    planes, transmittance = picture
    gain, offset = view.exposure[:3, 0, None, None], view.exposure[:3, 1, None, None]
    difference: Array = view.target[:3] - view.exposed(planes[:3])
    label = planes[3]
    blurred = uniform_filter(np.abs(difference).mean(axis=0), RIM)
    if len(view.target) > 3:
        shown = view.target[3] > 0.5
        new, stale = shown & (label < ABSENT), ~shown & (label > THERE)
        behind = ~shown & (label < ABSENT)
        new = binary_propagation(new & (blurred > DIFFERENT), mask=new)  # a mask alone may be wrong
    else:
        off = blurred > max(DIFFERENT, TIMES_USUAL * float(np.median(blurred)))
        new, stale = off & (label < THERE), off & (label >= THERE)
        behind = label < ABSENT
    bare = behind & (transmittance > BARE) & (blurred > DIFFERENT)
    image = np.moveaxis((view.target[:3] - offset) / gain, 0, -1)
    error = np.square(difference).mean(axis=0)
    return Novelty(view, camera, image, _wide(new), _wide(stale), label >= ABSENT, _wide(bare), behind, error)


def _wide(pixels: Bool) -> Bool:
    """Returns the mask of regions that are at least ``RIM`` pixels wide somewhere."""
    cores: Any = binary_opening(pixels, np.ones((RIM, RIM), np.bool_))
    grown: Bool = binary_propagation(cores, mask=pixels)
    return grown
