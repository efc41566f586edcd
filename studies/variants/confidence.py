"""Fit of the confidence of tracks: logistic regression on captures with known tracks, with one capture left out.

Each capture is reconstructed as it is and backwards. Its moving points are tracked from the first and from the middle
frame. A position is correct if its error is at most ``CORRECT_WITHIN`` of the extent of the moving Gaussians.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from client.cli.scores import Column, Row, markdown
from scas4d_core.captures import Capture, open_capture
from scas4d_core.gaussians import moving_extent
from scas4d_core.metrics import calibration_error
from scas4d_core.metrics.evaluation import moving_points
from scas4d_core.query import tracks as module
from scas4d_core.query.tracks import CORRECT_WITHIN, confidence_of
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.constants import varied
from studies.variants.variants import VARIANTS

Float = NDArray[np.float64]

PLAYED = ("as it is", "backwards")
"""Variants of each capture; the second has the second seed."""
SCALE = 0.5
"""Scale of the images."""
SAMPLE = 4000
"""Maximum number of positions of a run that are used, chosen at random. All runs count equally."""
BINS = 5
"""Number of rows of the reliability table."""
SMALLEST = 1e-4
"""Probability to which estimates are clipped in the loss."""


def run(captures: Sequence[Path], out: Path) -> str:
    """Measures the runs that are not in the folder ``out``, and returns the report as Markdown."""
    out.mkdir(parents=True, exist_ok=True)
    runs: dict[str, list[Float]] = {}
    for capture in captures:
        for seed, variant in enumerate(PLAYED):
            file = out / f"{capture.name}-{variant.replace(' ', '-')}.npy"
            if not file.exists():
                opened = open_capture(capture, image_scale=SCALE)
                rows = measure(opened if seed == 0 else VARIANTS[variant].made(opened), seed)
                np.save(file, rows)
                print(f"{file}: {len(rows)} positions")
            runs.setdefault(capture.name, []).append(np.load(file))
    return report(runs)


def measure(capture: Capture, seed: int) -> Float:
    """Reconstructs a capture and returns a row for each position of a moving point.

    Returns:
        [R, 4] opacity of the carriers, disagreement, frames from the query, and 1 if the position is correct.
    """
    truth = capture.ground_truth
    if truth is None:
        raise ValueError(f"{capture.name} has no known tracks; use captures with ground truth")
    settings = Settings.model_validate({"static": {"seed": seed, "seconds": None}, "update": {"seed": seed}})
    scene = Reconstruction.start(capture.rig, capture.frame(0), settings, points=capture.points)
    frames = range(capture.frame_count)
    for index in frames[1:]:
        scene.step(capture.frame(index))
    points = truth.points[: len(frames)]
    extent = capture.extent or float(np.ptp(points.reshape(-1, 3), axis=0).max())
    moving = moving_points(points, extent)
    rows: list[Float] = []
    for query in (0, len(frames) // 2):
        calls: list[tuple[Float, Float, int]] = []

        def recorded(covered: Float, disagreement: Float, frames: int, calls: list[Any] = calls) -> Float:
            calls.append((covered, disagreement, frames))
            return np.zeros(len(covered))

        with varied(f"{module.__name__}.confidence_of", recorded):
            tracks = scene.tracks_of_points(points[query], query, list(frames))
        limit = CORRECT_WITHIN * moving_extent(scene.history.gaussians(query)) / scene.world.metres_per_unit
        correct = np.linalg.norm(tracks.positions - points, axis=-1) <= limit  # false for lost positions
        for index, (covered, disagreement, apart) in enumerate(calls):
            if index != query:
                columns = covered, disagreement, np.full(len(covered), apart), correct[index]
                rows.append(np.column_stack(columns)[moving & np.isfinite(tracks.positions[index]).all(axis=-1)])
    return np.concatenate(rows)


def fit(runs: Sequence[Float]) -> Float:
    """Returns the logarithm of ``ODDS``, ``DISAGREEMENT`` and ``AGEING`` that maximize the likelihood."""
    rng = np.random.default_rng(0)
    samples = [rows[rng.permutation(len(rows))[:SAMPLE]] for rows in runs if len(rows)]

    def loss(constants: Float) -> float:
        losses = []
        for rows in samples:
            estimate = np.clip(confidence(rows, constants), SMALLEST, 1 - SMALLEST)
            losses.append(-np.log(np.where(rows[:, 3] > 0, estimate, 1 - estimate)).mean())
        return float(np.mean(losses))

    constants: Float = minimize(loss, [-1.0, 1.0, 0.5], method="BFGS").x
    return constants


def confidence(rows: Float, constants: Float) -> Float:
    """Returns ``confidence_of`` of each row with other constants; see ``fit``."""
    log_odds, disagreement, ageing = constants.tolist()
    covered, apart, frames = rows[:, :3].T
    return confidence_of(covered, apart, frames, (float(np.exp(log_odds)), disagreement, ageing))


def report(runs: dict[str, list[Float]]) -> str:
    """Returns the constants, the calibration error of each capture, left out of the fit, and a reliability table."""
    rng = np.random.default_rng(0)
    rows: list[Row] = []
    held_out: list[Float] = []
    for name, own in runs.items():
        constants = fit([measured for other, several in runs.items() if other != name for measured in several])
        positions = np.concatenate(own)
        estimate, correct = confidence(positions, constants), positions[:, 3] > 0
        rows.append({"name": name, "error": calibration_error(estimate, correct), **_means(estimate, correct)})
        held_out.append(np.column_stack([estimate, correct])[rng.permutation(len(positions))[:SAMPLE]])
    estimate, correct = np.concatenate(held_out).T
    odds, disagreement, ageing = fit([rows for own in runs.values() for rows in own])
    bin_of, bins = np.minimum((BINS * estimate).astype(int), BINS - 1), list[Row]()
    for k in np.unique(bin_of).tolist():
        inside = bin_of == k
        between = {"name": f"{k / BINS:g} to {(k + 1) / BINS:g}", "share": float(inside.mean())}
        bins.append(between | _means(estimate[inside], correct[inside]))
    means = (Column("mean confidence", "confidence"), Column("correct", "correct"))
    left_out = markdown(
        rows, (Column("capture, left out", "name"), Column("calibration error", "error", ".3f"), *means)
    )
    return "\n\n".join(
        [
            left_out,
            f"Calibration error over all captures: {calibration_error(estimate, correct > 0):.3f}. With all captures, "
            f"ODDS = {np.exp(odds):.2f}, DISAGREEMENT = {disagreement:.2f}, AGEING = {ageing:.2f}.",
            markdown(bins, (Column("confidence", "name"), Column("positions", "share", ".0%"), *means)),
        ]
    )


def _means(estimate: Float, correct: NDArray[Any]) -> Row:
    return {"confidence": float(estimate.mean()), "correct": float(correct.mean())}
