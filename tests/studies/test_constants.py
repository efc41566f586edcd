"""Constants of the method that a study varies."""

from __future__ import annotations

import pytest

from scas4d_core.engines import plan
from studies.constants import all_varied, varied


def test_a_constant_has_another_value_for_a_while() -> None:
    place, usual = "scas4d_core.engines.plan.MAX_SCALE", plan.MAX_SCALE
    with varied(place, 2.0):
        assert plan.MAX_SCALE == 2.0
    assert usual == plan.MAX_SCALE
    with all_varied([(place, 1.0), (place, 3.0)]):
        assert plan.MAX_SCALE == 3.0
    assert usual == plan.MAX_SCALE


def test_a_constant_that_is_not_there_is_refused() -> None:
    with pytest.raises(AttributeError, match="LARGEST"), varied("scas4d_core.engines.plan.LARGEST", 2.0):
        pass
