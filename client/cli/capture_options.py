"""Options shared by all commands and studies that read a capture, and the decorator that adds them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from client.importers.open_source import CaptureOptions, PicturesFrom
from client.left_out import LeftOut
from client.progress import console
from scas4d_core.captures import Capture, CaptureError, SizeMismatch


def _options(
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file or folder, if it is not inside CAPTURE; see docs/captures.md.")
    ] = None,
    pictures: Annotated[
        PicturesFrom | None, typer.Option(help="Kind of image files to use, if the capture has several kinds.")
    ] = None,
    capture_fps: Annotated[
        float | None, typer.Option(min=0.001, help="Frame rate; default: as specified by the files, or 30.")
    ] = None,
    masks: Annotated[bool, typer.Option(help="Use the capture's masks.")] = True,
    test: Annotated[
        list[str] | None, typer.Option(help="Hold out a camera for evaluation. May be repeated.", metavar="CAMERA")
    ] = None,
    size_mismatch: Annotated[
        SizeMismatch | None,
        typer.Option(
            help=(
                "How images whose aspect ratio differs from the calibration were produced: cropped at the "
                "right and bottom (corner), cropped evenly (centre), or resized (stretch)."
            )
        ),
    ] = None,
    bit_depth: Annotated[
        int | None,
        typer.Option(min=8, max=16, help="Bits that the values of 16-bit images use; default: found from the values."),
    ] = None,
) -> CaptureOptions:
    return CaptureOptions(
        calibration=calibration,
        pictures=pictures,
        fps=capture_fps,
        use_masks=masks,
        test=tuple(test or ()),
        size_mismatch=size_mismatch,
        bit_depth=bit_depth,
    )


def with_capture_options(command: Callable[..., None]) -> Callable[..., None]:
    """Adds the capture options to a command, which receives them as one `CaptureOptions` in its argument `options`.

    An option that the command itself declares, such as `masks`, is not replaced.

    >>> @with_capture_options
    ... def count(folder: Path, options: CaptureOptions) -> None:
    ...     print(options.open(folder).frame_count, options.test)
    >>> count(folder, test=["1"])
    4 ('1',)
    """
    given, shared = _parameters(command), _parameters(_options)
    own = [parameter for name, parameter in given.items() if name != "options"]
    added = [
        parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in shared.items()
        if name not in given
    ]
    names = {parameter.name for parameter in added}

    @wraps(command)
    def run(*given: Any, **named: Any) -> None:
        options = _options(**{name: named.pop(name) for name in list(named) if name in names})
        command(*given, options=options, **named)

    del run.__wrapped__
    run.__signature__ = inspect.Signature([*own, *added])  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in (*own, *added)}
    return run


def _parameters(function: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Returns a function's parameters, keyed by name, with resolved annotations."""
    hints = get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters
    return {name: parameter.replace(annotation=hints[name]) for name, parameter in parameters.items()}


def open_capture(folder: Path, options: CaptureOptions, **more: Any) -> Capture:
    """Opens a capture for a command and prints its remarks; `more` is passed to `open_source`."""
    capture = options.open(folder, **more)
    print_remarks(capture)
    return capture


def print_remarks(capture: Capture) -> None:
    """Prints the remarks that were recorded while reading a capture."""
    for remark in capture.remarks:
        note(remark)


def note(message: str) -> None:
    """Prints a message about a capture or its sending."""
    console.print(message, style="yellow", highlight=False, markup=False, soft_wrap=True)


def finish(left_out: LeftOut) -> None:
    """Prints how many images could not be used.

    Raises:
        CaptureError: if frames are left out. The command has done everything else, but its exit status is 1.
    """
    if left_out.frames:
        raise CaptureError(left_out.summary)
    if left_out.summary is not None:
        note(left_out.summary)
