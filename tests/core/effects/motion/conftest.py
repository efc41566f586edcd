"""The preparation of the small scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from effect_cases import RIG, builder

from scas4d_core.cameras import WorldFrame
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.preparation import Preparation
from scas4d_core.settings import Settings


@pytest.fixture
def preparation() -> Callable[[Settings], Preparation]:
    """Of the box, with settings."""
    factory = builder().factory
    renderer = CpuRenderer((0, 0, 0))
    assert factory.rig is RIG
    return lambda settings: Preparation(factory, settings, WorldFrame(np.zeros(3)), renderer)
