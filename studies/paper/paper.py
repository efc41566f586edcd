"""``scripts/bench paper``: repeats each experiment of the paper on the available captures.

Every experiment compares one setting with another by a single score. The outcome agrees in sign if the difference of
the means has the same sign as in the paper. It agrees in size if the two differences are also within a factor of two.
Two differences that are both small also agree. If the paper shows only an image, only the sign is compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from client.cli.scores import Store
from studies.frontier.frontier import AXES, DEFAULT, Variant
from studies.frontier.tradeoff import Point, read_points
from studies.paper import figures
from studies.paper.figures import Figures
from studies.quality.runs import measured_runs

FACTOR = 2.0
"""Largest factor between two differences that agree in size."""
SMALL: Mapping[str, float] = {
    "psnr": 0.3,
    "ssim": 0.005,
    "mte_2d_oracle": 0.1,
    "parts_ari": 0.05,
}
"""Maps each score to the difference below which two values count as equal."""


def variant(label: str) -> Variant:
    """Returns the frontier setting with the given label."""
    return next(v for axis in AXES.values() for v in axis if v.label == label)


@dataclass(frozen=True)
class ClaimSetting:
    """One setting of an experiment: its name in the paper, the frontier setting, and the paper's figures, if any."""

    name: str
    variant: Variant
    paper: Figures


@dataclass(frozen=True)
class Claim:
    """A comparison made in the paper: the gain of one setting over another.

    Attributes:
        what: description of the claim.
        first: name of the first setting.
        second: name of the second setting.
        expected: sign of the gain, or 0 for no difference, if the paper has no figures.
    """

    what: str
    first: str
    second: str
    expected: Literal[-1, 0, 1] | None = None


@dataclass(frozen=True)
class Experiment:
    """One experiment: a table of settings by captures, and the claims that it tests.

    Attributes:
        title: title of the experiment.
        source: place in the paper.
        score: name of the compared score.
        unit: name and unit of the score in words.
        sides: settings, in the order of the rows.
        claims: claims that the experiment tests.
        note: remarks for the page.
    """

    title: str
    source: str
    score: str
    unit: str
    sides: tuple[ClaimSetting, ...]
    claims: tuple[Claim, ...]
    note: str = ""


OURS = ClaimSetting("Ours, 100", DEFAULT, figures.PSNR_100)
BASE_100, BASE_300 = variant("dynamic3dgs 100"), variant("dynamic3dgs 300")
BASE_2000, OURS_2000 = variant("dynamic3dgs 2000"), variant("scas4d 2000")
SINGLE = ("K=1: 64", "K=1: 320", "K=1: 1280")

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        "Online comparison, PSNR", "table 1", "psnr", "PSNR in dB",
        (
            OURS,
            ClaimSetting("Dynamic3DGS, 100", BASE_100, figures.PSNR_BASELINE_100),
            ClaimSetting("Dynamic3DGS, 2000", BASE_2000, figures.PSNR_BASELINE_2000),
        ),
        (
            Claim("ahead with equal iterations", "Ours, 100", "Dynamic3DGS, 100"),
            Claim("close to the baseline with 20× the iterations", "Ours, 100", "Dynamic3DGS, 2000"),
        ),
    ),
    Experiment(
        "Online comparison, SSIM", "table 1", "ssim", "",
        (
            ClaimSetting("Ours, 100", DEFAULT, figures.SSIM_100),
            ClaimSetting("Dynamic3DGS, 100", BASE_100, figures.SSIM_BASELINE_100),
            ClaimSetting("Dynamic3DGS, 2000", BASE_2000, figures.SSIM_BASELINE_2000),
        ),
        (
            Claim("ahead with equal iterations", "Ours, 100", "Dynamic3DGS, 100"),
            Claim("close to the baseline with 20× the iterations", "Ours, 100", "Dynamic3DGS, 2000"),
        ),
    ),
    Experiment(
        "Equal wall-clock time, PSNR", "appendix", "psnr", "PSNR in dB",
        (OURS, ClaimSetting("Dynamic3DGS, 300", BASE_300, figures.PSNR_BASELINE_300)),
        (Claim("ahead of the baseline with 3× the iterations", "Ours, 100", "Dynamic3DGS, 300"),),
        "In the paper, 300 baseline iterations take as long as 100 iterations of its method. In these runs, a baseline "
        "iteration takes {ratio} as long as a `scas4d` iteration; [accuracy-and-time.md](accuracy-and-time.md) "
        "compares newer runs at equal time.",
    ),
    Experiment(
        "Equal wall-clock time, SSIM", "appendix", "ssim", "",
        (
            ClaimSetting("Ours, 100", DEFAULT, figures.SSIM_100),
            ClaimSetting("Dynamic3DGS, 300", BASE_300, figures.SSIM_BASELINE_300),
        ),
        (Claim("ahead of the baseline with 3× the iterations", "Ours, 100", "Dynamic3DGS, 300"),),
    ),
    Experiment(
        "Convergence: 2000 iterations each", "figure", "psnr", "PSNR in dB",
        (ClaimSetting("Ours, 2000", OURS_2000, {}), OURS,
         ClaimSetting("Dynamic3DGS, 2000", BASE_2000, figures.PSNR_BASELINE_2000)),
        (
            Claim("both converge to the same quality", "Ours, 2000", "Dynamic3DGS, 2000", 0),
            Claim("100 iterations are close to convergence", "Ours, 2000", "Ours, 100", 0),
        ),
    ),
    Experiment(
        "Number of layers", "table and appendix", "psnr", "PSNR in dB",
        (
            *(ClaimSetting(label, variant(label), figures.PSNR_LAYERS[1]) for label in SINGLE),
            ClaimSetting("K=2", variant("K=2"), figures.PSNR_LAYERS[2]),
            ClaimSetting("K=3", DEFAULT, figures.PSNR_LAYERS[3]),
            ClaimSetting("K=4", variant("K=4"), figures.PSNR_LAYERS[4]),
            ClaimSetting("K=5", variant("K=5"), figures.PSNR_LAYERS[5]),
        ),
        (
            *(Claim(f"three layers vs. one of {label.split()[-1]}", "K=3", label) for label in SINGLE),
            Claim("three layers vs. two", "K=3", "K=2"),
            Claim("three layers vs. four", "K=3", "K=4"),
            Claim("three layers vs. five", "K=3", "K=5"),
        ),
        "The paper does not state the number of clusters for K = 1, 2, 4 and 5. Here, single layers have 64, 320 or "
        "1280 clusters; for other K, the layers have 64 to 1280 clusters, evenly spaced on a log scale.",
    ),
    Experiment(
        "Number of first-layer clusters", "appendix", "psnr", "PSNR in dB",
        (
            *(ClaimSetting(f"N={n}", variant(f"N={n}"), figures.PSNR_FIRST_LAYER[n]) for n in (16, 32, 48)),
            ClaimSetting("N=64", DEFAULT, figures.PSNR_FIRST_LAYER[64]),
        ),
        tuple(Claim(f"64 clusters vs. {n}", "N=64", f"N={n}") for n in (16, 32, 48)),
    ),
    Experiment(
        "Maximum scale", "appendix", "psnr", "PSNR in dB",
        (
            ClaimSetting("max_scale 0.02", DEFAULT, figures.PSNR_100),
            ClaimSetting("max_scale 2.0", variant("max_scale 2 m"), figures.PSNR_MAX_SCALE_2),
        ),
        (Claim("the scale bound is needed", "max_scale 0.02", "max_scale 2.0"),),
    ),
    Experiment(
        "Entangled vs. separate covariance", "figure", "psnr", "PSNR in dB",
        (ClaimSetting("Entangled", DEFAULT, {}), ClaimSetting("Separate", variant("separate covariance"), {})),
        (Claim("better images", "Entangled", "Separate", 1),),
        "The paper shows only an image of its wheel. With separate covariance (`update.covariance`), the cascade moves "
        "only the means, and only a Gaussian's own ΔR and Δs change its covariance. ΔR and Δs are optimized from the "
        "start (`update.deltas_start` 0), not only after `40%` of the iterations.",
    ),
    Experiment(
        "Tracking: 2D MTE of the best candidate", "table 3", "mte_2d_oracle",
        "2D MTE in % of the image diagonal",
        (
            ClaimSetting("Ours, 100", DEFAULT, figures.MTE_100),
            ClaimSetting("Dynamic3DGS, 100", BASE_100, figures.MTE_BASELINE_100),
        ),
        (Claim("lower error (negative is better)", "Ours, 100", "Dynamic3DGS, 100"),),
    ),
    Experiment(
        "Segmentation: parts from cascade vs. per-Gaussian motion", "figure in the appendix", "parts_ari",
        "adjusted Rand index",
        (ClaimSetting("Ours, 100", DEFAULT, {}), ClaimSetting("Dynamic3DGS, 2000", BASE_2000, {})),
        (Claim("better parts", "Ours, 100", "Dynamic3DGS, 2000", 1),),
        "The paper shows only images. Here, parts are compared with ground-truth labels.",
    ),
)  # fmt: skip
"""Experiments in the order of the page."""

Measured = Mapping[tuple[Variant, str], Figures]
"""Maps each setting and score to our figure for each capture."""

AgreementWord = Literal["sign and size", "sign", "no", "not measured"]


@dataclass(frozen=True)
class ClaimResult:
    """Comparison of a claim in the paper with our figures.

    Attributes:
        claim: the claim.
        paper: the paper's mean gain over the captures used by both; None if the paper prints no figures.
        own: our mean gain over the same captures; None if not measured.
        captures: captures over which the gains are averaged.
        same_sign: number of these captures for which the sign of our gain agrees with the paper.
        agrees: whether the mean gains agree in sign and size, only in sign, or not at all.
    """

    claim: Claim
    paper: float | None
    own: float | None
    captures: tuple[str, ...]
    same_sign: int
    agrees: AgreementWord


def measured(out: Path, captures: Sequence[str], updates: int, quality: Path | None = None) -> Measured:
    """Returns our figures from the frontier study.

    For captures without figures in that study, the PSNR of ``scas4d`` and ``dynamic3dgs`` is taken from the quality
    study, over the updates that both cover.
    """
    by_variant: dict[tuple[Variant, str], dict[str, float]] = {}
    for point in read_points(out, captures, updates):
        for score in SMALL:
            value = point.scores[score]
            if value is not None:
                by_variant.setdefault((point.variant, score), {})[point.capture] = value
    if quality is not None and quality.is_dir():
        rows = measured_runs(Store(quality))
        for capture in captures:
            pair = [rows.get((run, capture)) for run in ("scas4d", "dynamic3dgs")]
            own, base = pair
            if own is None or base is None or capture in by_variant.get((DEFAULT, "psnr"), {}):
                continue
            shared = min(own["updates"], base["updates"])
            for setting, row in ((DEFAULT, own), (BASE_100, base)):
                psnr = row["psnr_by_frame"][1 : 1 + shared]
                by_variant.setdefault((setting, "psnr"), {})[capture] = sum(psnr) / shared
    return by_variant


def compare(experiment: Experiment, ours: Measured) -> list[ClaimResult]:
    """Compares each claim of an experiment with the measurements."""
    return [_outcome(experiment, claim, ours) for claim in experiment.claims]


def _outcome(experiment: Experiment, claim: Claim, ours: Measured) -> ClaimResult:
    sides = {side.name: side for side in experiment.sides}
    first, second = sides[claim.first], sides[claim.second]
    mine = [ours.get((side.variant, experiment.score), {}) for side in (first, second)]
    both = [name for name in figures.SCENES if name in mine[0] and name in mine[1]]
    printed = claim.expected is None
    if printed:
        both = [name for name in both if name in first.paper and name in second.paper]
    if not both:
        return ClaimResult(claim, None, None, (), 0, "not measured")
    gains = [mine[0][name] - mine[1][name] for name in both]
    own = sum(gains) / len(both)
    small = SMALL[experiment.score]
    if not printed:
        assert claim.expected is not None
        same = sum(_sign(gain, small) == claim.expected for gain in gains)
        return ClaimResult(claim, None, own, tuple(both), same, "sign" if _sign(own, small) == claim.expected else "no")
    theirs = [first.paper[name] - second.paper[name] for name in both]
    paper = sum(theirs) / len(both)
    same = sum(_agrees(gain, their, small) != "no" for gain, their in zip(gains, theirs, strict=True))
    return ClaimResult(claim, paper, own, tuple(both), same, _agrees(own, paper, small))


def _agrees(own: float, paper: float, small: float) -> AgreementWord:
    """Returns whether two gains agree in sign and size, only in sign, or not at all. Two small gains always agree."""
    if abs(own) < small and abs(paper) < small:
        return "sign and size"
    if own * paper <= 0:
        return "no"
    if 1 / FACTOR <= own / paper <= FACTOR:
        return "sign and size"
    return "no" if min(abs(own), abs(paper)) < small else "sign"


def _sign(value: float, small: float) -> int:
    return 0 if abs(value) < small else 1 if value > 0 else -1


def iteration_ratio(points: Sequence[Point]) -> float | None:
    """Returns the time of 100 baseline iterations relative to ``scas4d``, averaged over captures that have both.

    Returns None if there is no such capture.
    """
    own = {p.capture: p.seconds for p in points if p.variant == DEFAULT}
    base = {p.capture: p.seconds for p in points if p.variant == BASE_100}
    ratios = [base[name] / own[name] for name in own if name in base]
    return sum(ratios) / len(ratios) if ratios else None
