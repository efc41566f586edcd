"""Opens captures of any layout for studies and selects the cameras on which results are measured."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from client.cli.evaluate import DEFAULT_OPTIONS
from client.importers.open_source import CaptureOptions
from scas4d_core.captures import Capture


def open_measured(folder: Path | str, options: CaptureOptions = DEFAULT_OPTIONS, **more: Any) -> Capture:
    """Opens a capture for a study. If it has no test cameras, uses the training cameras instead and prints a note.

    Args:
        folder: capture folder.
        options: options for reading the capture.
        more: additional arguments for `open_source`.

    >>> open_measured("samples/robot").full_test_rig.names
    ('4', '11')
    """
    capture = options.open(folder, **more)
    if capture.full_test_rig is not None:
        return capture
    print(f"{capture.name} has no test cameras; measuring on its training cameras", file=sys.stderr)
    return capture.with_training_as_test()
