"""Reads the text, JSON and npz files of a capture, with detailed error messages. Requires only NumPy."""

from __future__ import annotations

import codecs
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class CaptureError(ValueError):
    """Raised if a capture cannot be read; the message names the file, the problem and the remedy."""


def read_text(path: Path) -> str:
    """Reads a text file in UTF-8 or, if it starts with the byte order mark of UTF-16, in UTF-16.

    The mark is removed, and all line ends become ``\\n``.

    Raises:
        CaptureError: if the file is missing, or is not text.
    """
    try:
        data = path.read_bytes()
        sixteen = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = data.decode("utf-16" if sixteen else "utf-8-sig")
    except FileNotFoundError as fault:
        raise CaptureError(f"{path}: no such file") from fault
    except (OSError, UnicodeDecodeError) as fault:
        raise CaptureError(f"{path} cannot be read as text ({fault}); save it as UTF-8") from fault
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json_value(path: Path) -> Any:
    """Reads a JSON file with any kind of value.

    Raises:
        CaptureError: if the file is missing, or is not valid JSON.
    """
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as fault:  # numbers of thousands of digits are a ValueError
        raise CaptureError(f"{path} is not valid JSON ({fault})") from fault


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON file that contains an object.

    Raises:
        CaptureError: if the file is missing, is not valid JSON, or does not contain an object.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise CaptureError(f"{path} must contain a JSON object; got {type(content).__name__}")
    return content


def read_npz(path: Path, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Reads the named arrays from an npz file; pickled objects are not allowed.

    Raises:
        CaptureError: if the file is missing or damaged, or lacks one of the keys.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {key: file[key] for key in keys}
    except KeyError as fault:
        raise CaptureError(f"{path}: missing array {fault}; required arrays: {', '.join(keys)}") from fault
    except Exception as fault:  # zipfile, zlib and numpy raise different exceptions
        raise CaptureError(
            f"{path} cannot be read as an npz file without pickles ({type(fault).__name__}: {fault})"
        ) from fault
    return arrays
