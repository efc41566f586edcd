"""Reads matrices that OpenCV's FileStorage wrote to YAML, XML or JSON, without OpenCV.

YAML and JSON store a matrix as a mapping with `rows`, `cols`, `dt` and `data`, and XML as an element with these
children. ROS writes the same fields, except `dt`.
(docs.opencv.org, "File Input and Output using XML / YAML / JSON files".)
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from client.importers.formats.documents import check_size, read_xml, read_yaml
from scas4d_core.captures import CaptureError
from scas4d_core.captures.files import read_json

XML, JSON = ".xml", ".json"


def read_storage(path: Path) -> dict[str, Any]:
    """Returns the top-level fields of a file, keyed by name. Matrices are flat lists, and scalars may be strings.

    Raises:
        CaptureError: if the file cannot be read.
        MissingExtraError: if the file is YAML, and PyYAML is not installed.
    """
    check_size(path)
    if path.suffix.lower() == JSON:
        document: Any = read_json(path)
    elif path.suffix.lower() == XML:
        try:
            document = {child.tag: _element(child) for child in read_xml(path)}
        except RecursionError as fault:
            raise CaptureError(f"{path}: its elements are nested too deeply; export the calibration again") from fault
    else:
        document = read_yaml(path)
    if not isinstance(document, dict):
        raise CaptureError(f"{path} contains no named fields; is this a calibration file?")
    return {str(key): _value(value) for key, value in document.items()}


def _value(value: Any) -> Any:
    return value["data"] if isinstance(value, Mapping) and "data" in value else value


def _element(element: ElementTree.Element) -> Any:
    """Returns the value of an XML element: a mapping, or the words of its text."""
    if len(element):
        return {child.tag: _element(child) for child in element}
    words = (element.text or "").split()
    return words[0].strip('"') if len(words) == 1 and element.tag != "data" else words


def first_field(stored: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """Returns the first of the named fields that has a value, or None."""
    return next((stored[name] for name in names if stored.get(name) not in (None, "")), None)
