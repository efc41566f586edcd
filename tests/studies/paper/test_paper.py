"""The paper's tables on rows made of formulas: what agrees with its figures, in sign and in size."""

import pytest
from made_frontier import made_psnr, made_row, made_study
from typer.testing import CliRunner

from client.cli.scores import Store
from studies.commands import app
from studies.frontier.frontier import DEFAULT
from studies.frontier.tradeoff import read_points
from studies.paper import figures
from studies.paper.page import needed
from studies.paper.paper import (
    BASE_100,
    BASE_2000,
    EXPERIMENTS,
    Claim,
    ClaimSetting,
    Experiment,
    compare,
    iteration_ratio,
    measured,
    variant,
)
from studies.quality.runs import RUNS


def gain(own: dict, paper: dict, expected=None):
    """The outcome of one comparison: figures of (first, second) by capture."""
    sides = (
        ClaimSetting("a", DEFAULT, {name: pair[0] for name, pair in paper.items()}),
        ClaimSetting("b", BASE_100, {name: pair[1] for name, pair in paper.items()}),
    )
    experiment = Experiment("made", "nowhere", "psnr", "dB", sides, (Claim("better", "a", "b", expected),))
    ours = {
        (DEFAULT, "psnr"): {name: pair[0] for name, pair in own.items()},
        (BASE_100, "psnr"): {name: pair[1] for name, pair in own.items()},
    }
    (outcome,) = compare(experiment, ours)
    return outcome


@pytest.mark.parametrize(
    ("own", "agrees"),
    [
        (6.0, "sign and size"),
        (12.0, "sign and size"),
        (12.1, "sign"),
        (2.9, "sign"),
        (0.25, "no"),
        (-6.0, "no"),
        (0.0, "no"),
    ],
)
def test_agreement_is_of_sign_and_then_of_size(own, agrees):
    outcome = gain({"robot": (20.0 + own, 20.0)}, {"robot": (26.0, 20.0)})
    assert (outcome.agrees, outcome.paper, outcome.own) == (agrees, 6.0, pytest.approx(own))


def test_no_difference_agrees_with_no_difference():
    assert gain({"robot": (20.0, 20.25)}, {"robot": (26.0, 25.9)}).agrees == "sign and size"
    assert gain({"robot": (20.0, 20.35)}, {"robot": (26.0, 25.9)}).agrees == "no"
    assert gain({"robot": (20.5, 20.0)}, {"robot": (26.0, 25.9)}).agrees == "no"
    assert gain({"robot": (20.35, 20.0)}, {"robot": (26.0, 25.8)}).agrees == "sign and size"


def test_only_captures_that_both_have_are_compared():
    outcome = gain(
        {"robot": (30.0, 20.0), "wheel": (20.0, 30.0), "stage": (0.0, 90.0)},
        {"robot": (30.0, 20.0), "wheel": (29.0, 28.0), "cloth": (0.0, 90.0)},
    )
    assert outcome.captures == ("robot", "wheel")
    assert (outcome.own, outcome.paper) == (0.0, 5.5)
    assert outcome.same_sign == 1
    assert gain({}, {"robot": (30.0, 20.0)}).agrees == "not measured"


def test_where_the_paper_has_a_picture_its_claim_is_the_sign():
    assert gain({"robot": (30.0, 20.0)}, {}, expected=1).agrees == "sign"
    assert gain({"robot": (20.2, 20.0)}, {}, expected=1).agrees == "no"
    assert gain({"robot": (20.2, 20.0)}, {}, expected=0).agrees == "sign"
    assert gain({"robot": (20.4, 20.0)}, {}, expected=0).agrees == "no"


def test_the_papers_figures_give_the_papers_means():
    five = figures.SCENES[:5]
    assert set(figures.PSNR_100) == set(figures.SCENES)
    assert set(figures.PSNR_LAYERS[2]) == set(five)
    for given, mean in (
        (figures.PSNR_100, (29.46 + 30.28 + 27.95 + 30.60 + 31.68) / 5),
        (figures.PSNR_LAYERS[3], (29.46 + 30.28 + 27.95 + 30.60 + 31.68) / 5),
        (figures.PSNR_FIRST_LAYER[64], (29.46 + 30.28 + 27.95 + 30.60 + 31.68) / 5),
    ):
        assert sum(given[name] for name in five) / 5 == pytest.approx(mean)


def test_every_experiment_compares_what_it_has():
    for experiment in EXPERIMENTS:
        names = {side.name for side in experiment.sides}
        assert len(names) == len(experiment.sides)
        for claim in experiment.claims:
            assert {claim.first, claim.second} <= names
    wanted = needed()
    assert len(set(wanted)) == len(wanted)
    assert {DEFAULT, BASE_2000, variant("K=5"), variant("N=16"), variant("max_scale 2 m")} <= set(wanted)
    assert variant("separate covariance") in wanted


def test_captures_without_rows_come_from_the_study_of_quality(tmp_path):
    made_study(tmp_path / "frontier", ("robot",), axes=("iterations",))
    store = Store(tmp_path / "quality")
    for name, psnr in (("scas4d", [29.0, 28.0, 26.0]), ("dynamic3dgs", [29.0, 25.0])):
        row = made_row(DEFAULT, "basketball", len(psnr) - 1, key=name, psnr_by_frame=psnr)
        row["settings"] = RUNS[name].settings().model_dump(mode="json")
        store.put(row)
    found = measured(tmp_path / "frontier", ["robot", "basketball"], 5, tmp_path / "quality")
    assert found[DEFAULT, "psnr"] == {"robot": pytest.approx(made_psnr(DEFAULT)), "basketball": 28.0}  # one update both
    assert found[BASE_100, "psnr"]["basketball"] == 25.0
    assert "basketball" not in found[BASE_2000, "psnr"]
    assert iteration_ratio(read_points(tmp_path / "frontier", ["robot"], 5)) == pytest.approx(0.5)


def test_the_command_writes_every_experiment(tmp_path):
    made_study(tmp_path / "study", ("robot", "cloth"))
    captures = [str(tmp_path / name) for name in ("robot", "cloth")]
    page = tmp_path / "docs" / "paper.md"
    options = ["--out", str(tmp_path / "study"), "--no-measure", "--page", str(page)]
    done = CliRunner().invoke(app, ["paper", *captures, *options])
    assert done.exit_code == 0, done.output
    text = page.read_text()
    for experiment in EXPERIMENTS:
        assert (f"\n## {experiment.title}\n" in text) == (experiment.score != "ssim")
        assert f"\n| {experiment.title} | " in text
    assert "not measured" not in text.split("## Online comparison")[0].replace("are not measured", "")
    ours, base = made_psnr(DEFAULT), made_psnr(BASE_100)
    assert f"| Ours, 100 | {ours:.2f} (29.46) | {ours:.2f} (31.68) | {ours:.2f} (30.57) |" in text
    assert (
        "| Online comparison, PSNR | ahead with equal iterations | Ours, 100 – Dynamic3DGS, 100 "
        f"| {ours - base:+.2f} | +9.21 | sign and size | 2 of 2 |" in text
    )
    other = made_psnr(variant("separate covariance"))
    gain_of_map = f"Entangled – Separate | {ours - other:+.2f} | – | sign | 2 of 2 |"
    assert f"| Entangled vs. separate covariance | better images | {gain_of_map}" in text
    times = "0.50<!-- paper-equal-wall-clock-time-psnr.iteration_ratio --> times"
    assert f"takes {times} as long as a `scas4d` iteration" in text
    assert "Measured: 2026-01-02<!-- paper-agreement.date -->, with earlier" in text
    assert "21<!-- paper-agreement.comparisons --> comparisons" in text
    for name in ("agreement", "number-of-layers", "tracking"):
        assert f"\n<!-- table: paper-{name} -->\n| " in text
