"""Base class and field types of the wire models."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat

from scas4d_core.cameras import CAMERA_NAME
from scas4d_core.errors import InputError

MAX_CAMERAS = 512
MAX_PIXELS_A_SIDE = 16_384
MAX_LABELS = 16
MAX_NAME = 200
"""Maximum number of characters of a scene's name."""
LABEL_WORD = r"[A-Za-z0-9](?:[A-Za-z0-9_.-]{0,61}[A-Za-z0-9])?"
"""Pattern for a label's value and for both parts of its name around the slash, as accepted by Ray and Kubernetes."""

CameraName = Annotated[
    str,
    Field(
        pattern=CAMERA_NAME,
        description=("Letters, digits, dots, dashes and underscores; not `time`, and not starting with `mask.`."),
    ),
]


def check_labels(labels: dict[str, str]) -> dict[str, str]:
    """Returns the labels unchanged, or raises an `InputError` if a node label is invalid."""
    for name, value in labels.items():
        for what, text, pattern in (("name", name, f"(?:{LABEL_WORD}/)?{LABEL_WORD}"), ("value", value, LABEL_WORD)):
            if re.fullmatch(pattern, text) is None:
                raise InputError(
                    f"{text[:80]!r} is not a valid {what} for a node label",
                    "use names and values of 1 to 63 letters, digits, dots, dashes and underscores that start and "
                    "end with a letter or digit; a name may contain one slash, such as studio.example/rig",
                )
    return labels


CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that control a terminal, break lines, reverse the order of text or are not Unicode text."""


def escaped(text: str) -> str:
    """Returns the text with its control characters as escape sequences.

    >>> escaped("studio\\n4")
    'studio\\\\n4'
    """
    return CONTROL.sub(lambda control: ascii(control[0])[1:-1], text)


def check_text(text: str) -> str:
    """Returns the text unchanged, or raises an `InputError` if it contains a control character."""
    if (control := CONTROL.search(text)) is not None:
        fault = f"contains the control character {control[0]!a} at position {control.start()}"
        raise InputError(fault, "use printable text without line breaks")
    return text


DisplayText = Annotated[str, AfterValidator(check_text)]
"""Text that other users see in terminals, logs and the viewer."""

Labels = Annotated[dict[str, str], Field(max_length=MAX_LABELS), AfterValidator(check_labels)]
"""Node labels: values keyed by name."""
Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Pixel = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]


class Model(BaseModel):
    """Base class of the wire models. Unknown fields are errors, so that misspelled names are detected."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)
