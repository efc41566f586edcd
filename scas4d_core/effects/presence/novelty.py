"""Pixels of a frame that show what the state does not have, and those where the state shows what is not there.

With a mask a pixel is new where the mask has foreground and the rendered label has none. Without, it is new where the
picture differs from the rendering of what stands. What merely moved and was not followed shows as both, new pixels and
stale ones, of about the same number: only what is new beyond what is stale can have entered.
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
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.gaussians import Gaussians
    from scas4d_core.update.result import UpdateTrace

Bool = NDArray[np.bool_]
Array = NDArray[np.float32]

THERE, ABSENT = 0.5, 0.3
"""Rendered label from which a pixel shows a moving Gaussian, and below which it shows none."""
RIM = 3
"""Pixels: narrower regions are rims, where the outline of what is known is off by a pixel."""
BARE = 0.5
"""Transmittance that is left, from which the state has nothing in a pixel."""
DIFFERENT, TIMES_USUAL = 0.1, 3.0
"""Without masks: the mean difference of a channel, 0…1, in a square of ``RIM`` pixels, from which it is another thing;
and times the median of such differences over the picture."""


@dataclass(frozen=True, eq=False)
class Novelty:
    """What a camera says about a frame.

    Attributes:
        view: of the frame. camera: inside. image: [H, W, 3] of its picture, 0…1, as the scene's colours are.
        new: [H, W] shows what the state does not have. stale: [H, W] the state shows what is not there.
        covered: [H, W] the state shows a moving thing, which something new may lie behind.
        bare: [H, W] the state shows nothing at all where the picture has something that stands. behind: [H, W] picture
            and state show static Gaussians, as far as can be measured.
        error: [H, W] squared difference of picture and rendering, mean over the channels.
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
        """New pixels beyond the stale ones."""
        return int(self.new.sum()) - int(self.stale.sum())


class CoarseNovelty(NamedTuple):
    """What a thinned rendering of the end of an update says, roughly, without another rendering.

    Attributes:
        view: of the frame. new, bare: shares of the pixels, see ``Novelty``; regions come out smaller by their rims.
    """

    view: TrainingView
    new: float
    bare: float


SCREENED_CAMERAS = 6
"""Cameras at most that are looked at in each frame before all are; where the update has left no rendering, others each
time."""
COARSE_SHARE = 0.5
"""Of a share of pixels: a glimpse has to find so much of it. On the captures it finds 0.6 to 0.9 of such as count; of
rims that are none, 0.2 to 0.6."""

_novelty_cache: WeakKeyDictionary[Gaussians, dict[str, Novelty]] = WeakKeyDictionary()
"""What cameras say, by state: several effects ask for the same."""
_coarse_cache: WeakKeyDictionary[UpdateTrace, list[CoarseNovelty]] = WeakKeyDictionary()
"""Those of an update."""


def screen_novelty(seen: FrameObservation, least: int, new: float = 0.0, bare: float = 0.0) -> list[Novelty]:
    """What some cameras say of a frame; nothing where too few of them can say that something is new, or bare.

    Args:
        least: cameras that have to. new, bare: share of its pixels that each of them has to see as such.
    """
    glimpses = _coarse_novelties(seen) if seen.result.trace.kept is Candidate.END else []
    if (
        len(glimpses) >= min(SCREENED_CAMERAS, len(seen.views)) > 0
    ):  # fewer say too little: it ended otherwise than planned
        seem = [one.view for one in glimpses if one.new >= COARSE_SHARE * new and one.bare >= COARSE_SHARE * bare]
        return novelty_of_views(seen, seem[: max(SCREENED_CAMERAS, least)]) if len(seem) >= least else []
    count = len(seen.views)
    looked_at = min(SCREENED_CAMERAS, count)
    return novelty_of_views(seen, [seen.views[(seen.index + count * k // looked_at) % count] for k in range(looked_at)])


def _coarse_novelties(seen: FrameObservation) -> list[CoarseNovelty]:
    """Those of the cameras that the update rendered last."""
    trace = seen.result.trace
    if trace not in _coarse_cache:
        _coarse_cache[trace] = [
            _coarse_novelty(view, trace.shown[view.name]) for view in seen.views if view.name in trace.shown
        ]
    return _coarse_cache[trace]


def _coarse_novelty(view: TrainingView, thinned: Thinned) -> CoarseNovelty:
    """One of a view and its rendering; four pixels that touch have to agree."""
    every, shown = thinned
    target = view.target[:, ::every, ::every]
    gain, offset = view.exposure[:3, 0, None, None], view.exposure[:3, 1, None, None]
    difference = sum(_corners(np.abs(target[:3] - (gain * shown[:3] + offset)).mean(axis=0))) / 4
    label, transmittance = shown[3], shown[4]
    if len(target) > 3:
        new, stands = (target[3] > 0.5) & (label < ABSENT), (target[3] <= 0.5) & (label < ABSENT)
        new_squares = _all_corners(new)
    else:
        stands = label < ABSENT
        new_squares = _all_corners(label < THERE) & (
            difference > max(DIFFERENT, TIMES_USUAL * float(np.median(difference)))
        )
    bare = _all_corners(stands & (transmittance > BARE)) & (difference > DIFFERENT)
    return CoarseNovelty(view, float(new_squares.mean()), float(bare.mean()))


def _corners(plane: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """[h − 1, w − 1] four times, the pixels of each square of two by two."""
    return plane[:-1, :-1], plane[:-1, 1:], plane[1:, :-1], plane[1:, 1:]


def _all_corners(plane: Bool) -> Bool:
    one, two, three, four = _corners(plane)
    everywhere: Bool = one & two & three & four
    return everywhere


def novelty_of_views(seen: FrameObservation, views: Sequence[TrainingView]) -> list[Novelty]:
    """What some views say, in the colours of the frame before: what is new may be painted on what stands by now."""
    state = seen.result.gaussians
    known = _novelty_cache.setdefault(state, {})
    missing = [view for view in views if view.name not in known or known[view.name].view is not view]
    colours = state.colours.copy()
    colours[: len(seen.before)] = seen.before.colours
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
    """What each view says against a state.

    Args:
        state: Θ_t, updated to the frame. colours: [N, 3] RGB to render: of the frame before, so that what is new has
            not been painted on what stands. views: of the frame.
    """
    shown = state.replace(colours=colours)
    return [_novelty(shown, view, rig[view.name], renderer) for view in views]


def _novelty(state: Gaussians, view: TrainingView, camera: Camera, renderer: Renderer) -> Novelty:
    planes, transmittance = renderer.render(state, view.camera)
    gain, offset = view.exposure[:3, 0, None, None], view.exposure[:3, 1, None, None]
    difference: Array = view.target[:3] - (gain * planes[:3] + offset)
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
    """The regions that are somewhere as wide as ``RIM``."""
    cores: Any = binary_opening(pixels, np.ones((RIM, RIM), np.bool_))
    grown: Bool = binary_propagation(cores, mask=pixels)
    return grown
