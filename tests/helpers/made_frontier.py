"""A study of the frontier made here: rows of formulas, so that what is read from them is known."""

from math import exp, log10
from pathlib import Path

from client.cli.scores import Store, digest
from studies.frontier.frontier import Variant, variants

STAGES = ("render", "cascade", "adam")


def made_psnr(variant: Variant) -> float:
    """dB: scas4d comes near its best after 40 iterations, the baseline after 400; changes cost a little."""
    scale = 40 if variant.preset == "scas4d" else 400
    return 33 - 14 * exp(-variant.iterations / scale) - 0.5 * len(variant.changes)


def made_seconds(variant: Variant) -> float:
    return variant.iterations * (0.01 if variant.preset == "scas4d" else 0.005)


def made_row(variant: Variant, capture: str, updates: int, **more: object) -> dict:
    frames = updates + 1
    psnr, seconds = made_psnr(variant), made_seconds(variant)
    settings = variant.record
    return {
        "key": f"{capture}-{variant.preset}-{digest(settings, frames)}",
        "capture": capture,
        "preset": variant.preset,
        "iterations": variant.iterations,
        "settings": settings,
        "given": {"frames": frames, "masks": True, "points": True},
        "capture_frames": 24,
        "updates": frames - 1,
        "gaussians": 20_000,
        "measured": "2026-01-02T03:04:05+00:00",
        "core": "0123abcd",
        "machine": {"processor": "A Processor", "cores": 2, "threads": 1, "system": "Linux"},
        "psnr": psnr,
        "psnr_by_frame": [37.0, *[psnr] * (frames - 1)],
        "psnr_foreground": psnr - 8,
        "ssim": 0.9 + 0.001 * psnr,
        "flip": 0.02,
        "track_3d_median": 0.3,
        "mte_2d": 0.5,
        "mte_2d_oracle": 10 / psnr,
        "parts_ari": None if capture == "cloth" else 0.02 * psnr,
        "flicker": 40 * log10(40 / psnr),
        "seconds_update": 7 * seconds,  # of a busy machine
        "cpu_seconds_update": seconds,
        "seconds_stages": {name: seconds / len(STAGES) for name in STAGES},
        **more,
    }


def made_study(folder: Path, captures: tuple[str, ...], updates: int = 5, axes: tuple[str, ...] = ()) -> Store:
    store = Store(folder)
    for capture in captures:
        for variant in variants(axes):
            store.put(made_row(variant, capture, updates))
    return store
