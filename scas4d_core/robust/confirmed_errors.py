"""Errors in a camera's image that other cameras confirm.

A camera that has moved, is dirty or lags contradicts the other cameras, which fit as usual. An object that enters the
scene, or an update that lags behind, causes errors as well, but in every camera that sees the place. Such errors must
not count against the camera that sees them best.

For each erroneous cell of an image, points along its ray are projected into the other cameras. If most of the images
that contain a point have errors there, the errors of the cell are confirmed. A connected region of errors is confirmed
as a whole if many of its cells are confirmed at one depth. Cells that too few other images contain do not count,
because images often show only part of an object.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import inf, log10
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, maximum_filter

from scas4d_core.cameras import Camera, Rig
from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.posed_pictures import pixels_inside
from scas4d_core.update.view_factory import ViewFactory

CELLS = 64
"""Maximum number of cells along the longer side of an image."""
SMALLEST = 2
"""Minimum edge of a cell, in pixels. Errors of single pixels are noise."""
RENDERED = 128
"""Images are halved while their longer side has at least twice this number of pixels."""
USUAL_PERCENTILE = 75
"""Percentile of the squared errors of an image's opaque cells that counts as usual. An object that covers less than a
quarter of an image does not change it."""
DISTINCT = 8.0
"""Squared error above which a cell is erroneous, relative to the usual error in the other images."""
ROUNDING = 1 / 255**2
"""Lower bound on the usual error: images have 8 bits."""
LARGEST = 300
"""Maximum number of erroneous cells that are tested, starting with the largest errors."""
DEPTHS = 64
"""Number of points per ray. Their ratio is 5%, which shifts a projection by about a cell."""
NEAREST, FARTHEST = 0.12, 3.0
"""Range of depths along a ray, relative to the median depth of the Gaussians in the image."""
SIMILAR = 0.25
"""Minimum squared error of another camera at a point, relative to that of the tested cell. Backgrounds differ between
cameras, so errors differ as well."""
MIN_WITNESSES = 2
"""Minimum number of other cameras that see a point."""
AGREE = 0.75
"""Minimum share of these cameras that have an error there."""
MAX_WITNESSES = 12
"""Maximum number of cameras, spread over the rig, that may confirm errors. The time grows with its square."""
MOST, PART = 0.4, 0.05
"""Minimum confirmed shares of the squared error in a connected region that confirm the whole region. The first applies
to the cells that other cameras see at the depth of the object, and the second to all cells."""
STATIC = 0.25
"""Maximum label of a cell that shows static content. Moving Gaussians have label 1, and their errors move with them."""

Array = NDArray[np.float32]
Bool = NDArray[np.bool_]


class CellErrors(NamedTuple):
    """Errors of a state in the cells of an image.

    Attributes:
        squares: [h, w] squared error of each cell, as a mean over pixels and RGB.
        differences: [h, w] mean difference between the image and the state in each cell.
        static: [h, w] whether each cell shows static content.
        usual: ``USUAL_PERCENTILE`` of the squared errors of opaque cells, or 0 if there are none.
        edge: edge of a cell, in pixels of the camera.
    """

    squares: Array
    differences: Array
    static: Bool
    usual: float
    edge: float


class ImageErrors:
    """Errors of a state in the images of one frame. Each image is rendered at most once, when it is needed.

    Args:
        views: training views of the frame.
        factory: factory that created the views.
        renderer: renderer for the state.
        state: state to compare the images with.

    Attributes:
        names: names of the cameras that have a view.
        rig: rig with all of these cameras.
    """

    def __init__(
        self, views: Sequence[TrainingView], factory: ViewFactory, renderer: Renderer, state: Gaussians
    ) -> None:
        self._views = {view.name: view for view in views}
        self.names, self.rig = tuple(self._views), factory.posed
        self._factory, self._renderer, self._state = factory, renderer, state
        self._errors: dict[str, CellErrors] = {}

    def errors(self, name: str) -> CellErrors:
        """Returns the errors in the cells of a camera's image."""
        if name not in self._errors:
            self._errors[name] = cell_errors(self._views[name], self._factory, self._renderer, self._state)
        return self._errors[name]

    def confirmed(self, name: str, witnesses: Collection[str]) -> Bool:
        """Returns the [h, w] mask of a camera's erroneous cells that other cameras confirm.

        Args:
            name: name of the camera.
            witnesses: names of the cameras that may confirm errors. The camera itself is ignored.
        """
        depths = ray_depths(self.rig[name], self._state)
        return confirmed_cells(name, self.errors(name), self._others(name, witnesses), self.rig, depths)

    def credited_decibels(self, names: Collection[str]) -> dict[str, float]:
        """Returns by how much the PSNR of each named camera would rise without the errors that other cameras confirm.

        All cameras that have a view may confirm errors.

        Returns:
            A value in dB of at least 0 for each named camera that has a view.
        """
        credits = {}
        for name in names:
            if name in self._views:
                cells, confirmed = self.errors(name).squares, self.confirmed(name, self.names)
                usual = _distinct(self._others(name, self.names))
                without = np.where(confirmed, np.minimum(cells, usual), cells)
                credits[name] = 10 * log10(max(cells.mean(), ROUNDING) / max(without.mean(), ROUNDING))
        return credits

    def _others(self, name: str, witnesses: Collection[str]) -> dict[str, CellErrors]:
        return {other: self.errors(other) for other in witnesses if other != name}


def cell_errors(view: TrainingView, factory: ViewFactory, renderer: Renderer, state: Gaussians) -> CellErrors:
    """Returns the errors of a state in the cells of a view."""
    scale, full = 1.0, view.camera.width
    while max(view.camera.width, view.camera.height) >= 2 * RENDERED:
        scale /= 2
        view = factory.coarser(view, scale)
    features, transmittance = renderer.render(state, view.camera)
    edge = max(SMALLEST, -(-max(transmittance.shape) // CELLS))
    difference = view.target[:LABEL] - view.exposed(features[:LABEL])
    squares = _cells(np.square(difference).mean(axis=0), edge)
    opaque = squares[_cells(transmittance, edge) < 0.5]
    usual = float(np.percentile(opaque, USUAL_PERCENTILE)) if len(opaque) else 0.0
    differences, static = _cells(difference.mean(axis=0), edge), _cells(features[LABEL], edge) < STATIC
    return CellErrors(squares, differences, static, usual, edge * full / view.camera.width)


def _cells(plane: Array, edge: int) -> Array:
    """Returns the mean of a plane [H, W] in each cell. Cells at the border are filled with the nearest pixels."""
    padded = np.pad(plane, [(0, -side % edge) for side in plane.shape], mode="edge")
    height, width = (side // edge for side in padded.shape)
    cells: Array = padded.reshape(height, edge, width, edge).mean(axis=(1, 3))
    return cells


def ray_depths(camera: Camera, state: Gaussians) -> NDArray[np.float64]:
    """Returns the ``DEPTHS`` depths at which a camera's rays are tested, in metres; empty if it sees no Gaussian."""
    _, _, depth, inside = pixels_inside(camera, state.means.astype(np.float64))
    if not inside.any():
        return np.empty(0)
    middle = float(np.median(depth[inside]))
    return np.geomspace(NEAREST * middle, FARTHEST * middle, DEPTHS)


def confirmed_cells(
    name: str, own: CellErrors, others: Mapping[str, CellErrors], rig: Rig, depths: NDArray[np.float64]
) -> Bool:
    """Returns the [h, w] mask of a camera's erroneous cells that other cameras confirm.

    Args:
        name: name of the camera.
        own: errors of this camera.
        others: errors of the other cameras, keyed by camera name.
        rig: rig with all of these cameras.
        depths: [D] depths at which points along the rays are tested, in metres.

    Returns:
        The confirmed cells. They include whole regions of connected erroneous cells.
    """
    cells = own.squares
    erroneous = cells > _distinct(others)
    # A stable sort has the same order on every processor.
    tested = np.argsort(-np.where(erroneous, cells, -1), axis=None, kind="stable")[: min(LARGEST, erroneous.sum())]
    if not len(tested) or not len(depths):
        return np.zeros(cells.shape, np.bool_)
    camera = rig[name]
    row, column = np.unravel_index(tested, cells.shape)
    uv = own.edge * (np.stack([column, row], axis=1) + 0.5)
    points = np.concatenate([camera.unproject(uv, np.full(len(uv), depth)) for depth in depths])
    agree, asked = (np.zeros(len(points), np.int64) for _ in range(2))
    least = np.tile(SIMILAR * cells[row, column], len(depths))
    for other, errors in others.items():
        across, down, _, inside = pixels_inside(rig[other], points)
        nearby = maximum_filter(errors.squares, 3)  # a point projects between two cells
        at = (down / errors.edge).astype(np.int64), (across / errors.edge).astype(np.int64)
        asked += inside
        agree += inside & (nearby[at] >= least)
    visible = (asked >= MIN_WITNESSES).reshape(len(depths), len(tested))
    agreed = visible & (agree >= AGREE * asked).reshape(visible.shape)
    confirmed = np.zeros(cells.shape, np.bool_)
    confirmed[row, column] = agreed.any(axis=0)
    regions, _ = label(erroneous, np.ones((3, 3)))
    here = regions[row, column]
    whole = [
        region
        for region in np.unique(here)
        if _is_confirmed(cells[row, column][here == region], visible[:, here == region], agreed[:, here == region])
    ]
    result: Bool = confirmed | np.isin(regions, whole)
    return result


def _is_confirmed(squares: Array, visible: Bool, agreed: Bool) -> bool:
    """Returns whether a region of errors belongs to one object that other cameras confirm.

    Args:
        squares: [T] squared errors of the region's cells.
        visible: [D, T] whether enough other cameras see the point of a cell at a depth.
        agreed: [D, T] whether these cameras confirm the error of the cell at a depth.
    """
    confirmed, seen = agreed @ squares, visible @ squares
    depth = int(confirmed.argmax())
    return bool(confirmed[depth] >= max(MOST * seen[depth], PART * squares.sum()))


def _distinct(others: Mapping[str, CellErrors]) -> float:
    """Returns the squared error above which a cell is erroneous, given the errors of the other cameras."""
    return DISTINCT * max(ROUNDING, float(np.median([one.usual for one in others.values()]))) if others else inf
