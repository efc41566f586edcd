"""Effects against auto: variants that the settings allow, figures of pairs updated in turns, rows that are kept."""

from pathlib import Path

import pytest

from scas4d_core.settings import Settings
from studies.quality import effects

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
QUICK = ("scene.image_scale=0.25", "static.iterations=20", "static.max_gaussians=500", "update.iterations=8")
PINS = ({"cluster_rotation": "off", "cluster_translation": "off", "cluster_scaling": "off"},)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    out, lines = tmp_path_factory.mktemp("study"), list[str]()
    given = {"names": ("leaving",), "frames": 3, "changes": QUICK, "report": lines.append}
    first = effects.run([SAMPLE], out, pins=PINS, **given)
    files = {path: path.stat().st_mtime_ns for path in (out / "effects").iterdir()}
    again = effects.run([SAMPLE], out, pins=PINS, **given)
    assert files == {path: path.stat().st_mtime_ns for path in (out / "effects").iterdir()}
    return out, first, again, lines


def test_an_effect_that_is_off_changes_no_bit_if_pinned(measured):
    _, rows, _, _ = measured
    by_pin = {row["pinned"]: row for row in rows}
    row = by_pin["leaving off"]
    assert row["in_auto"] == "off"
    assert row["same_bits"] == "yes"
    assert row["gain"] == 0
    assert row["seconds_ratio"] > 0
    assert row["updates"] == 2


def test_effects_that_are_pinned_together_change_the_result(measured):
    _, rows, _, _ = measured
    row = rows[-1]
    assert row["pinned"] == "cluster_rotation off, cluster_translation off, cluster_scaling off"
    assert row["in_auto"] == ", ".join(["on since 0"] * 3)
    assert row["same_bits"] == "no"
    auto, pinned = row["psnr_by_frame"]
    assert row["gain"] == pytest.approx(sum(pinned) / 2 - sum(auto) / 2, abs=2e-3)
    assert row["gain"] < 0


def test_what_is_on_disk_is_not_measured_again(measured):
    out, first, again, lines = measured
    assert again == first
    assert len(list((out / "first").iterdir())) == 1  # all variants start from one frame 0
    assert "| robot | leaving off | off | 2 |" in (out / "effects.md").read_text()
    assert lines[-1] == (out / "effects.md").read_text().rstrip("\n")


def test_only_variants_that_the_settings_allow():
    dull = Settings.model_validate({"update": {"rate_static_colour": 0.0}})
    assert effects.variants(["shadows"], dull) == []
    assert {"floor": "on"} not in effects.variants(["floor"], Settings())  # no floor is named
    with pytest.raises(ValueError, match="unknown effect 'flour'"):
        effects.variants(["flour"], dull)
    with pytest.raises(ValueError, match="at least 2"):
        effects.run([SAMPLE], Path("nowhere"), frames=1)
