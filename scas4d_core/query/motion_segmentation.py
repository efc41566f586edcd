"""Finds how many parts move differently, by the unexplained motion that each merge of two groups would cause.

The Gaussians are divided into small patches. Groups of patches are merged in pairs, and each merge is judged by the RMS
relative motion of the two groups: the distance between their Gaussians and the best common rigid motion, minus what
their own rigid motions leave. It is compared with the track noise plus the deformation of the group that deforms less.
In a bar that stretches evenly, two halves move apart by √12 times the RMS deviation of each half from a rigid motion.
Groups whose relative motion clearly exceeds this are separate parts.

All quantities are sums over pairs of frames, and a Gaussian counts in the pairs in which it is present. So Gaussians
that come and go are compared only over their common frames.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from scas4d_core.gaussians import quaternions_to_matrices

Float = NDArray[np.float64]
Int = NDArray[np.int64]

STATIC = -1
"""Label of parts that do not move."""
SEPARATE = 4.0
"""Relative motion of two separate parts, in units of the noise and the deformation within them. It is √12 for even
stretching, plus a margin, because deformation is rarely even."""
NOISE = 0.0015
"""Track noise below which no relative motion is evidence, in units of the extent. The medians of the track errors
measured on the captures are 0.07 to 0.6% of the extent."""
WITHIN = 1.5
"""Maximum noise of a patch, in units of the RMS deviation of its Gaussians from a rigid motion."""
MIN_SHARE = 0.015
"""Smallest part, as a share of the weight of all Gaussians; smaller groups join the group that moves most alike."""
KEEP = 1.25
"""Factor by which the evidence must exceed the threshold before a previous part is split or merged."""
FRAMES = 16
"""Number of frames that are enough, evenly spaced. The time grows with their number."""
REFERENCES = 4
"""Number of frames that are paired with all others."""
PATCH, MAX_PATCHES = 40, 120
"""Gaussians per patch, and the maximum number of patches."""
LEVER = 0.03
"""Distance from a Gaussian's centre, in units of the extent, at which its rotation counts as a displacement."""
OUTLIER = 2.5
"""Gaussians are excluded from a patch if their residual exceeds this multiple of the patch's median residual."""
NEIGHBOURS = 8
"""Number of neighbours whose residuals are averaged with a Gaussian's own residual before it is assigned to a part."""
NEAR_PATCHES = 6
"""Number of nearest patches whose motions a Gaussian is compared with."""
ROWS_AT_ONCE = 1 << 15
"""Number of Gaussians that are compared with the parts at once, which limits the memory."""
SEED = 0


@dataclass(frozen=True, eq=False)
class Tracks:
    """Motion of M Gaussians over T frames, in units of their extent.

    Attributes:
        positions: [T, M, 3] positions, centred.
        turns: [T, M, 3, 3] material rotations.
        present: [T, M] whether the Gaussian is in the scene.
        weights: [M] positive weights with mean 1.
        pairs: [P, 2] pairs of frames.
    """

    positions: Float
    turns: Float
    present: NDArray[np.bool_]
    weights: Float
    pairs: Int

    def rows(self, rows: Any) -> Tracks:
        """Returns the tracks of some Gaussians."""
        return Tracks(
            self.positions[:, rows], self.turns[:, rows], self.present[:, rows], self.weights[rows], self.pairs
        )


@dataclass(frozen=True, eq=False)
class Moments:
    """Weighted sums over the Gaussians of K groups in P pairs of frames, from which rigid motions follow.

    Attributes:
        weight: [K, P] sum of the weights.
        source, target: [K, P, 3] sums of the positions in the first and second frame of the pair.
        cross: [K, P, 3, 3] sum of target · sourceᵀ, including rotations at the distance ``LEVER``.
        spread: [K, P] sum of |source|² + |target|², including rotations.
    """

    weight: Float
    source: Float
    target: Float
    cross: Float
    spread: Float

    def __getitem__(self, rows: Any) -> Moments:
        return Moments(*(getattr(self, field.name)[rows] for field in fields(self)))

    def __add__(self, other: Moments) -> Moments:
        return Moments(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))

    def put(self, row: int, other: Moments) -> None:
        """Replaces the sums of one group."""
        for field in fields(self):
            getattr(self, field.name)[row] = getattr(other, field.name)

    def residuals(self) -> Float:
        """Returns the weighted sum of squared distances from the best rigid motions, over all pairs, [K]."""
        weight = np.maximum(self.weight, 1e-12)
        cross = self.cross - self.target[..., :, None] * (self.source / weight[..., None])[..., None, :]
        spread = self.spread - (np.square(self.source) + np.square(self.target)).sum(-1) / weight
        left: Float = np.where(self.weight > 0, np.maximum(spread - 2 * _best_trace(cross), 0), 0).sum(-1)
        return left

    def static_residuals(self) -> Float:
        """Returns the weighted sum of squared displacements over all pairs, [K]."""
        moved: Float = np.maximum(self.spread - 2 * np.trace(self.cross, axis1=-2, axis2=-1), 0).sum(-1)
        return moved

    def motions(self) -> Motions:
        """Returns the best rigid motion of each group in each pair of frames."""
        weight = np.maximum(self.weight, 1e-12)[..., None]
        cross = self.cross - self.target[..., :, None] * (self.source / weight)[..., None, :]
        size = np.linalg.norm(cross, axis=(-2, -1))[..., None, None]
        left, _, right = np.linalg.svd(cross + (1e-9 * size + 1e-15) * np.eye(3))
        left[..., 2] *= np.linalg.det(left @ right)[..., None]
        turns = left @ right
        shifts = (self.target - np.einsum("kpij,kpj->kpi", turns, self.source)) / weight
        return Motions(turns, shifts, self.weight > 0)


class Motions(NamedTuple):
    """Rigid motions of G groups in P pairs of frames.

    Attributes:
        turns: [G, P, 3, 3] rotations.
        shifts: [G, P, 3] translations.
        known: [G, P] whether the group is in the scene in both frames.
    """

    turns: Float
    shifts: Float
    known: NDArray[np.bool_]

    def of(self, group: int) -> Motions:
        """Returns the motions of one group."""
        return Motions(self.turns[[group]], self.shifts[[group]], self.known[[group]])


def segment_motion(
    positions: NDArray[Any],
    rotations: NDArray[Any],
    present: NDArray[np.bool_],
    weights: NDArray[Any],
    previous: NDArray[Any] | None = None,
    sample: NDArray[np.intp] | None = None,
) -> Int:
    """Returns the part of each Gaussian, [M]; ``STATIC`` for parts that do not move.

    Args:
        positions: [T, M, 3] positions over time; finite, and near the scene where a Gaussian is absent.
        rotations: [T, M, 4] material rotations as unit quaternions (w, x, y, z).
        present: [T, M] whether a Gaussian is in the scene.
        weights: [M] nonnegative weights.
        previous: [M] labels from fewer frames, or None. Only clear evidence splits or merges previous parts.
        sample: rows from which the parts are determined; None for all.

    >>> points = np.random.default_rng(0).random((400, 3))
    >>> points[200:] += [2, 0, 0]
    >>> moved = points + np.repeat([[[0, 0, 0]], [[0, 0, 1]]], 200, axis=1).reshape(1, 400, 3) * [[[0]], [[0.2]]]
    >>> still = np.tile([1.0, 0, 0, 0], (2, 400, 1))
    >>> labels = segment_motion(moved, still, np.ones((2, 400), bool), np.ones(400))
    >>> set(labels[:200].tolist()), set(labels[200:].tolist())
    ({-1}, {0})
    """
    pairs = _frame_pairs(len(positions))
    if not len(pairs):
        return np.zeros(positions.shape[1], np.int64)
    centre, (low, high) = positions[0].mean(axis=0), np.percentile(positions[0], (1, 99), axis=0)
    extent = max(float(np.max(high - low)), 1e-12)
    mass = np.maximum(weights, 1e-9) / max(float(np.mean(weights)), 1e-9)

    def tracks(rows: Any) -> Tracks:
        return Tracks(
            (positions[:, rows].astype(np.float64) - centre) / extent,
            quaternions_to_matrices(rotations[:, rows].astype(np.float64)),
            present[:, rows],
            mass[rows],
            pairs,
        )

    rows = np.arange(positions.shape[1]) if sample is None else sample
    chosen = tracks(rows)
    patches = _patches(chosen)
    moments = _robust_moments(chosen, patches)
    merging = _Merging(moments, None if previous is None else _label_weights(previous[rows], patches, chosen))
    groups = merging.run()
    usable = np.flatnonzero(moments.weight.sum(-1) > 0)  # other patches are in no two frames
    if not len(usable):
        return np.zeros(positions.shape[1], np.int64)
    ids = np.unique(groups[usable])
    motions = _PartMotions(chosen, patches, usable, moments, merging.moments[ids], np.searchsorted(ids, groups[usable]))
    blocks = range(0, positions.shape[1], ROWS_AT_ONCE)
    evidence = np.concatenate([motions.evidence(tracks(slice(b, b + ROWS_AT_ONCE))) for b in blocks], axis=1)
    evidence = _pooled(evidence, positions[0])
    unknown = (np.ptp(evidence, axis=0) == 0) & (len(ids) > 1)  # neither a Gaussian nor its neighbours have moved
    shares = np.bincount(evidence.argmin(axis=0), mass, minlength=len(ids)) / mass.sum()
    evidence[(shares < MIN_SHARE) & (shares < shares.max())] = np.inf
    parts = evidence.argmin(axis=0)
    result: Int = np.where(merging.static(ids)[parts] | unknown, STATIC, parts).astype(np.int64)
    return result


def evenly_spaced(count: int, most: int) -> NDArray[np.intp]:
    """Returns at most ``most`` evenly spaced indices of ``count`` frames, with the first and the last.

    >>> evenly_spaced(10, 4).tolist()
    [0, 3, 6, 9]
    """
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(np.intp))


def _frame_pairs(frames: int) -> Int:
    """Returns pairs of frames [P, 2]: a few evenly spaced references with all other frames."""
    references = evenly_spaced(frames, REFERENCES)
    pairs = {(min(s, t), max(s, t)) for s in references.tolist() for t in range(frames) if s != t}
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def _patches(tracks: Tracks) -> Int:
    """Returns the patch of each Gaussian [M]: K-means clusters of positions, rotations and presence in a few frames."""
    from sklearn.cluster import KMeans

    frames, rows = tracks.present.shape
    few = evenly_spaced(frames, 6)
    features = np.concatenate(
        [
            tracks.positions[few].transpose(1, 0, 2).reshape(rows, -1),
            (4 * LEVER) * tracks.turns[few].transpose(1, 0, 2, 3).reshape(rows, -1),
            0.5 * tracks.present[few].T,
        ],
        axis=1,
        dtype=np.float32,
    )
    count = min(rows, int(np.clip(rows // PATCH, 20, MAX_PATCHES)))
    labels = KMeans(count, n_init=1, max_iter=12, random_state=SEED).fit_predict(features)
    return np.unique(labels, return_inverse=True)[1].astype(np.int64)


def _moments(tracks: Tracks, patches: Int, kept: NDArray[np.bool_]) -> Moments:
    count, size = int(patches.max()) + 1, len(tracks.pairs)
    sums = np.empty((count, size, 17))
    members = csr_matrix((np.ones(len(patches)), (patches, np.arange(len(patches)))), (count, len(patches)))
    for pair, (first, second) in enumerate(tracks.pairs):
        source, target = tracks.positions[first], tracks.positions[second]
        turned = LEVER**2 * np.einsum("nij,nkj->nik", tracks.turns[second], tracks.turns[first])
        cross = target[:, :, None] * source[:, None, :] + turned
        spread = np.square(source).sum(-1) + np.square(target).sum(-1) + 6 * LEVER**2
        columns = [np.ones((len(source), 1)), source, target, cross.reshape(-1, 9), spread[:, None]]
        weights = tracks.weights * (kept & tracks.present[first] & tracks.present[second])
        sums[:, pair] = members @ (weights[:, None] * np.concatenate(columns, axis=1))
    weight, source, target, cross, spread = np.split(sums, (1, 4, 7, 16), axis=-1)
    return Moments(weight[..., 0], source, target, cross.reshape(count, size, 3, 3), spread[..., 0])


def _robust_moments(tracks: Tracks, patches: Int) -> Moments:
    """Returns the moments of the patches without Gaussians that move differently from the rest of their patch."""
    kept = np.ones(len(patches), bool)
    for _ in range(2):
        motions = _moments(tracks, patches, kept).motions()
        for patch in range(len(motions.turns)):
            rows = np.flatnonzero(patches == patch)
            left = np.sqrt(_residuals(tracks.rows(rows), motions.of(patch))[0])
            kept[rows] = left <= OUTLIER * np.median(left) + 1e-9
    return _moments(tracks, patches, kept)


def _residuals(tracks: Tracks, motions: Motions) -> Float:
    """Returns the mean squared distance [G, M] of Gaussians from motions, infinite without common pairs of frames."""
    turns, shifts, known = motions
    count = len(tracks.weights)
    total, number = np.zeros((len(turns), count)), np.zeros((len(turns), count))
    for pair, (first, second) in enumerate(tracks.pairs):
        both = tracks.present[first] & tracks.present[second] & known[:, pair, None]
        moved = np.matmul(tracks.positions[first], np.swapaxes(turns[:, pair], -1, -2)) + shifts[:, pair, None]
        between = np.matmul(tracks.turns[second], np.swapaxes(tracks.turns[first], -1, -2)).reshape(count, 9)
        agreement = turns[:, pair].reshape(-1, 9) @ between.T
        apart = np.square(moved - tracks.positions[second]).sum(-1) + LEVER**2 * (6 - 2 * agreement)
        total += np.where(both, np.maximum(apart, 0), 0)
        number += both
    return np.where(number > 0, total / np.maximum(number, 1), np.inf)


def _label_weights(labels: NDArray[Any], patches: Int, tracks: Tracks) -> Float:
    """Returns the weight of each label in each patch, [K, L]; the first column is for Gaussians without a label."""
    counts = np.zeros((int(patches.max()) + 1, int(labels.max(initial=-1)) + 2))
    np.add.at(counts, (patches, np.maximum(labels, -1) + 1), tracks.weights)
    return counts


class _Merging:
    """Merges patches into groups, most similar motion first.

    All distances are mean squares, or their sums over the Gaussians and pairs of frames of a group.

    Args:
        moments: moments of the patches.
        known: [K, L] weight of each previous label in each patch, or None.

    Attributes:
        moments: moments of the groups. A group has the row of one of its patches.
        _known: [K, L] weight of each previous label in each group, or None.
        _own: [K] sum of squared distances from the rigid motion of the group.
        _inner: [K] the same from the rigid motions of its patches.
        _mass, _size: [K] weight in all pairs of frames, and the largest weight in a pair.
        _alive: [K] whether the row is a group; rows of merged patches are not.
        _groups: [K] group of each patch.
        _apart: [K, K] relative motion of two groups.
        _noise: [K] track noise of each group, the mean over its patches; ``_usual_noise`` is the median of the patches.
    """

    def __init__(self, moments: Moments, known: Float | None) -> None:
        self.moments = moments[np.arange(len(moments.weight))]
        self._known = None if known is None else known.copy()
        count = len(moments.weight)
        self._own = self.moments.residuals()
        self._inner = self._own.copy()
        self._mass = self.moments.weight.sum(-1)
        self._size = self.moments.weight.max(-1)
        self._alive = self._mass > 0
        self._groups = np.arange(count)
        self._apart = np.full((count, count), np.inf)
        for row in range(count):
            self._apart[row, :row] = self._apart[:row, row] = self._relative_motion(row, np.arange(row))
        # The motion relative to the most similar patch: noise in rigid parts, deformation in others. The most similar
        # patch of a small part may belong to another part, so the deviation within the patch limits the noise.
        nearest = self._apart.min(axis=1, initial=np.inf)
        within = self._own / np.maximum(self._mass, 1e-12)
        self._noise = np.minimum(np.where(np.isfinite(nearest), nearest, 0), WITHIN**2 * within)
        self._usual_noise = float(np.median(self._noise[self._alive])) if self._alive.any() else 0.0

    def run(self) -> Int:
        """Returns the group of each patch, named after one of its patches."""
        scores = self._scores(np.arange(len(self._alive)))
        smallest = MIN_SHARE * self._size[self._alive].sum()
        while True:
            first, second = np.unravel_index(np.argmin(scores), scores.shape)
            if not scores[first, second] <= SEPARATE**2:
                small = np.flatnonzero(self._alive & (self._size < smallest) & np.isfinite(scores.min(axis=1)))
                if not small.size:
                    return self._groups
                first = small[np.argmin(self._size[small])]
                second = np.argmin(scores[first])
            keep, gone = int(first), int(second)
            self._merge(keep, gone)
            scores[gone], scores[:, gone] = np.inf, np.inf
            scores[keep] = scores[:, keep] = self._scores(np.array([keep]))[0]

    def static(self, groups: Int) -> NDArray[np.bool_]:
        """Returns whether each group moves no more than its noise explains."""
        moments = self.moments[groups]
        mass = np.maximum(moments.weight.sum(-1), 1e-12)
        moved = (moments.static_residuals() - moments.residuals()) / mass
        noise = np.minimum(self._noise[groups], self._usual_noise)  # a lost track is no evidence for a static part
        still: NDArray[np.bool_] = moved <= SEPARATE**2 * (NOISE**2 + noise)
        return still

    def _merge(self, keep: int, gone: int) -> None:
        self.moments.put(keep, self.moments[keep] + self.moments[gone])
        mass = self._mass[[keep, gone]]
        self._noise[keep] = mass @ self._noise[[keep, gone]] / max(mass.sum(), 1e-12)
        self._mass[keep], self._size[keep] = mass.sum(), self._size[[keep, gone]].sum()
        self._inner[keep] += self._inner[gone]
        if self._known is not None:
            self._known[keep] += self._known[gone]
        self._alive[gone] = False
        self._groups[self._groups == gone] = keep
        self._own[keep] = self.moments[[keep]].residuals()[0]
        others = np.flatnonzero(self._alive & (np.arange(len(self._alive)) != keep))
        self._apart[keep] = np.inf
        self._apart[keep, others] = self._relative_motion(keep, others)
        self._apart[:, keep] = self._apart[keep]

    def _relative_motion(self, row: int, others: Int) -> Float:
        """Returns the mean squared motion of a group relative to others; infinite if they have no common frames."""
        if not len(others):
            return np.empty(0)
        one, other = self.moments[[row]], self.moments[others]
        cost = np.maximum((one + other).residuals() - self._own[row] - self._own[others], 0)
        weight = (one.weight * other.weight / np.maximum(one.weight + other.weight, 1e-12)).sum(-1)
        return np.where(weight > 1e-9, cost / np.maximum(weight, 1e-9), np.inf)

    def _scores(self, rows: Int) -> Float:
        """Returns the relative motions [R, K] in units of the smaller allowance of the two groups, squared."""
        deformation = np.maximum(self._own - self._inner, 0) / np.maximum(self._mass, 1e-12)
        allowance = NOISE**2 + self._noise + deformation
        scores: Float = self._apart[rows] / np.minimum(allowance[rows][:, None], allowance[None])
        if self._known is not None:
            label = self._known.argmax(axis=1)
            one, other = label[rows][:, None], label[None]
            factor = np.where(one == other, 1 / KEEP**2, KEEP**2)
            scores = scores * np.where((one > 0) & (other > 0), factor, 1)
        scores[:, ~self._alive] = np.inf
        scores[np.arange(len(rows)), rows] = np.inf
        return scores


class _PartMotions:
    """Motions of the parts and of their patches. The patches are needed because parts may deform.

    Args:
        tracks: tracks of the Gaussians in the patches.
        patches: [M] patch of each Gaussian.
        usable: [U] patches to use.
        moments, parts: moments of the patches and the parts.
        part_of: [U] part of each usable patch.
    """

    def __init__(
        self, tracks: Tracks, patches: Int, usable: Int, moments: Moments, parts: Moments, part_of: Int
    ) -> None:
        self._parts, self._patches, self._part_of = parts.motions(), moments[usable].motions(), part_of
        starts = tracks.positions[0]
        self._near = cKDTree([starts[patches == patch].mean(axis=0) for patch in usable])

    def evidence(self, tracks: Tracks) -> Float:
        """Returns the logarithm of the mean squared distance of Gaussians from each part's motion, [parts, M].

        It is the smallest over the motion of the part and of its patches near the Gaussian.
        """
        left = _residuals(tracks, self._parts)
        nearest = self._near.query(tracks.positions[0], k=min(NEAR_PATCHES, self._near.n))[1]
        nearest = nearest.reshape(left.shape[1], -1)
        for patch in np.unique(nearest):
            rows, part = np.flatnonzero((nearest == patch).any(axis=1)), self._part_of[patch]
            fitted = _residuals(tracks.rows(rows), self._patches.of(patch))[0]
            left[part, rows] = np.minimum(left[part, rows], fitted)
        left[:, ~np.isfinite(left).any(axis=0)] = 1.0  # without motion, the neighbours decide
        logarithms: Float = np.log(np.minimum(left, 1.0) + NOISE**2)
        return logarithms


def _pooled(evidence: Float, starts: NDArray[Any]) -> Float:
    """Returns the evidence [parts, M] of each Gaussian plus the mean of its neighbours in the first frame."""
    count = len(starts)
    neighbours = cKDTree(starts).query(starts, k=min(NEIGHBOURS + 1, count))[1].reshape(count, -1)
    around: Float = np.stack([row[neighbours].mean(axis=-1) for row in evidence])
    return evidence + around


def _best_trace(cross: Float) -> Float:
    """Returns the maximum of trace(Rᵀ · cross) over rotations R, in closed form [...].

    It is the sum of the singular values, the smallest of which has the sign of the determinant.
    """
    gram = np.swapaxes(cross, -1, -2) @ cross
    determinant = np.linalg.det(cross)
    mean = np.trace(gram, axis1=-2, axis2=-1) / 3
    centred = gram - mean[..., None, None] * np.eye(3)
    scale = np.sqrt(np.square(centred).sum(axis=(-2, -1)) / 6)
    ratio = np.linalg.det(centred) / np.maximum(2 * scale**3, 1e-300)
    angle = np.arccos(np.clip(ratio, -1, 1)) / 3
    largest = np.maximum(mean + 2 * scale * np.cos(angle), 0)
    smallest = np.maximum(mean + 2 * scale * np.cos(angle + 2 * np.pi / 3), 0)
    middle = np.maximum(3 * mean - largest - smallest, 0)
    two = np.sqrt(largest) * np.sqrt(middle)
    last = determinant / np.where(two > 0, two, 1)
    trace: Float = np.sqrt(largest) + np.sqrt(middle) + np.where(two > 0, last, 0)
    return trace
