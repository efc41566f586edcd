"""An iteration enters few parallel regions: each costs microseconds, which more threads do not make fewer."""

from statistics import median

import pytest
from box_regions import regions_of_box

from studies.apart import in_a_process

pytestmark = pytest.mark.slow
MOST = 10
"""Cascade, projection, tile covers, tile lists, blending, image loss, blending and projection backward, neighbours and
cascade backward. Adam takes the box's few rows on one thread."""


def test_an_iteration_enters_one_parallel_region_a_stage():
    regions = in_a_process(regions_of_box)
    assert 0 < median(regions) <= MOST
