"""Reads the YAML and XML documents of calibration tools, and fields of documents that JSON and YAML have in common."""

from __future__ import annotations

import codecs
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from client.importers.extras import load
from scas4d_core.captures import CaptureError
from scas4d_core.captures.files import read_json_value, read_text
from scas4d_core.errors import exact

LARGEST_FILE = 16 << 20
START = 1 << 16
LARGEST_JSON = 1 << 30
"""Reconstructions in JSON include points and their observations."""
DIRECTIVE = re.compile(r"\A%YAML[: ]1\.\d\s*\n(---[ \t]*\n)?")
"""OpenCV writes `%YAML:1.0`, which is not a directive of YAML."""


def check_size(path: Path, largest: int = LARGEST_FILE) -> None:
    """Raises a `CaptureError` if a file is missing, or too large for a calibration file."""
    try:
        size = path.stat().st_size
    except OSError as fault:
        raise CaptureError(f"{path} cannot be read: {fault.strerror}") from fault
    if size > largest:
        raise CaptureError(f"{path} is larger than {largest >> 20} MB; this is not a calibration file")


def json_value(path: Path, *words: str) -> Any:
    """Returns the value of a JSON file, to find out its format.

    The result is None if the file is too large, is not JSON, or starts with none of the words. Captures may contain
    thousands of other JSON files, so these are not parsed.
    """
    try:
        check_size(path, LARGEST_JSON)
        with path.open("rb") as file:
            start = file.read(START)
        encoded = (word.encode(code) for word in words for code in ("utf-8", "utf-16-le", "utf-16-be"))
        return read_json_value(path) if not words or any(word in start for word in encoded) else None
    except (CaptureError, OSError):
        return None


def read_yaml(path: Path) -> Any:
    """Returns the document of a YAML file. All scalars are strings, so a camera named `00` keeps its name.

    Raises:
        CaptureError: if the file is not YAML.
        MissingExtraError: if PyYAML is not installed.
    """
    yaml = load("yaml", needed="reading YAML files")
    check_size(path)

    class Loader(yaml.BaseLoader):  # type: ignore[misc, name-defined]
        """Reads tagged mappings, such as `!!opencv-matrix`, like untagged ones."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):  # nested aliases can stand for a document of any size
                raise yaml.YAMLError("aliases (*name) are not supported; write the values out")
            return super().compose_node(parent, index)

    def untagged(loader: Any, _: str, node: Any) -> Any:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        if isinstance(node, yaml.SequenceNode):
            return loader.construct_sequence(node, deep=True)
        return loader.construct_scalar(node)

    Loader.add_multi_constructor("", untagged)
    try:
        return Loader(DIRECTIVE.sub("", read_text(path))).get_single_data()
    except (yaml.YAMLError, RecursionError) as fault:
        raise CaptureError(f"{path} cannot be read as YAML: {' '.join(str(fault).split())}") from fault


def read_xml(path: Path) -> ElementTree.Element:
    """Returns the root element of an XML file.

    Raises:
        CaptureError: if the file is not XML, or declares a document type, which no calibration tool does.
    """
    check_size(path)

    def declared(*_: Any) -> None:
        raise CaptureError(f"{path} declares a document type, which no calibration tool does; export it again")

    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = declared
    try:
        parser.Parse(path.read_bytes().removeprefix(codecs.BOM_UTF8), True)
    except (OSError, expat.ExpatError, LookupError, ValueError) as fault:  # of encodings that expat does not support
        raise CaptureError(f"{path} cannot be read as XML ({fault}); export the calibration again") from fault
    return builder.close()


def number(where: str, given: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """Returns a finite number, which may be written as a string.

    Args:
        where: file and position in the file, for messages.
        given: fields.
        key: name of the field.
        default: value of a missing field; None if the field is required.

    Raises:
        CaptureError: if the field is missing, or is not a finite number.
    """
    value = given.get(key)
    if value is None and default is not None:
        return default
    try:
        parsed = math.nan if isinstance(value, bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        parsed = math.nan
    if not math.isfinite(parsed):
        raise CaptureError(f"{where}: {key} must be a finite number; got {short(value)}")
    return parsed


def positive(where: str, given: Mapping[str, Any], key: str, default: float | None = None) -> float:
    """Returns a finite number above 0, as `number` does.

    Raises:
        CaptureError: if the field is missing or is not such a number.
    """
    value = number(where, given, key, default)
    if value <= 0:
        raise CaptureError(f"{where}: {key} must be positive; got {exact(value)}")
    return value


def whole(where: str, given: Mapping[str, Any], key: str, most: int = 1 << 16) -> int:
    """Returns an integer from 1 to `most`, such as an image's width.

    Raises:
        CaptureError: if the field is missing or is not such a number.
    """
    value = number(where, given, key)
    if value != round(value) or not 1 <= value <= most:
        raise CaptureError(f"{where}: {key} must be a whole number from 1 to {most}; got {exact(value)}")
    return int(value)


def short(given: Any) -> str:
    """Returns a value for a message, at most 80 characters of it."""
    text = "nothing" if given is None else repr(given)
    return text if len(text) <= 80 else f"{text[:79]}…"


def table(where: str, given: Any, what: str) -> Mapping[str, Any]:
    """Returns a mapping.

    Raises:
        CaptureError: if the value is anything else. The message names it as `what`.
    """
    if not isinstance(given, Mapping):
        raise CaptureError(f"{where}: {what} must be a mapping; got {type(given).__name__}")
    return given
