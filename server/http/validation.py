"""Conversion of pydantic validation errors into problems with field, value and remedy.

Pydantic's messages describe the fault ("Input should be less than or equal to 100"); this module adds the remedy.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from scas4d_core.errors import InputError, exact
from server.problems import Problem, count_noun

MISSING = "nothing"
"""Text reported as the value of a missing field."""
EXCERPT = 20
"""Number of characters to quote on either side of a JSON syntax error."""

BOUNDS = {"gt": "greater than", "ge": "at least", "lt": "less than", "le": "at most"}
UNION = re.compile(r"constrained-\w+|(function|literal|lax-or-strict|nullable).*|.*\[.*\]|str|int|float|[A-Z]\w+")
"""Pattern of the parts of pydantic's `loc` that name a member of a union instead of a field."""

KINDS = {
    "int": "an integer",
    "float": "a number",
    "decimal": "a number",
    "finite": "a finite number (not NaN or infinity)",
    "bool": "true or false",
    "string": "text",
    "list": "a list […]",
    "tuple": "a list […]",
    "dict": "an object {…}",
    "model": "an object {…}",
    "mapping": "an object {…}",
}
"""Description of the expected type, keyed by the first word of pydantic's error type."""


def validation_problem(
    error: Mapping[str, Any],
    *,
    model: object = None,
    prefix: str = "",
    others: int = 0,
    text: str | None = None,
    schema: str = "see /openapi.json for the schema",
) -> Problem:
    """Returns the problem for one validation error.

    Args:
        error: entry of `ValidationError.errors()`.
        model: model that was validated, used to suggest field names. The error's `loc`, without a leading "body", is
            relative to it.
        prefix: prefix for the problem's field name.
        others: number of further errors.
        text: request text, if the error may be due to malformed JSON.
        schema: hint in the remedy about where all fields are listed.
    """
    loc = tuple(part for part in error["loc"] if isinstance(part, int) or not UNION.fullmatch(part))
    fault, ours = fault_and_remedy(error)
    if error["type"] == "json_invalid":
        return _json_problem(error, loc, prefix, text)
    field = ".".join(str(part) for part in ((prefix,) if prefix else ()) + loc) or "message"
    value = MISSING if error["type"] in ("missing", "union_tag_not_found") else error.get("input")
    inner = loc[1:] if loc[:1] == ("body",) else loc
    more = f" (and {others} more)" if others else ""
    return Problem(
        422,
        f"{field}: {fault}{more}",
        field=field,
        value="null" if value is None else value,
        remedy=ours or _remedy(error, field, fields_of(model, inner[:-1]), schema),
    )


def first_problem(
    error: ValidationError, *, model: object = None, prefix: str = "", text: str | None = None
) -> Problem:
    """Returns the problem for the first error of a failed validation."""
    faults = error.errors()
    return validation_problem(faults[0], model=model, prefix=prefix, others=len(faults) - 1, text=text)


def fields_of(model: object, loc: tuple[int | str, ...] = ()) -> list[str]:
    """Returns the field names of the model at `loc` within `model`, or an empty list if there is no model."""
    here = list(_models(model))
    for part in loc:
        if isinstance(part, str):
            inner = [one.model_fields[part].annotation for one in here if part in one.model_fields]
            here = [inner_model for annotation in inner for inner_model in _models(annotation)]
    return list(dict.fromkeys(name for one in here for name in one.model_fields))


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    """Yields the models that occur in a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)


def _json_problem(error: Mapping[str, Any], loc: tuple[Any, ...], prefix: str, text: str | None) -> Problem:
    at = loc[-1] if loc and isinstance(loc[-1], int) else None
    sent = text if text is not None else str(error.get("input", ""))
    value = sent if at is None else sent[max(0, at - EXCERPT) : at + EXCERPT]
    reason = str(error.get("ctx", {}).get("error", error["msg"])).removesuffix(
        " at"
    )  # "Unterminated string starting at"
    place = "" if at is None else f" at character {at}"
    field = prefix or (str(loc[0]) if loc else "message")
    return Problem(
        422,
        f"the {field} is not valid JSON: {reason[:1].lower()}{reason[1:]}{place}",
        field=field,
        value=value or MISSING,
        remedy="send well-formed JSON: names and text in double quotes, no trailing comma, no comments",
    )


def fault_and_remedy(error: Mapping[str, Any]) -> tuple[str, str]:
    """Returns the fault and the remedy of an error; the remedy is empty for pydantic's own errors."""
    raised = error.get("ctx", {}).get("error") if error["type"] == "value_error" else None
    if isinstance(raised, InputError):
        return raised.fault, raised.remedy
    return str(error["msg"] if raised is None else raised), ""


def _remedy(error: Mapping[str, Any], field: str, known: list[str], schema: str) -> str:
    kind, context = str(error["type"]), error.get("ctx", {})
    name = field.rpartition(".")[2]
    if kind == "missing":
        return f"add {name!r}; {schema}"
    if kind == "extra_forbidden":
        near = difflib.get_close_matches(name, known, 1)
        meant = f"did you mean {near[0]!r}? " if near else ""
        return f"{meant}omit it, or use one of {', '.join(known)}" if known else f"omit it; {schema}"
    if bounds := [f"{words} {exact(context[bound])}" for bound, words in BOUNDS.items() if bound in context]:
        return f"use a number that is {' and '.join(bounds)}"
    if kind in ("literal_error", "enum"):
        return f"use one of {context['expected']}"
    if kind == "union_tag_invalid":
        return f"use one of {context['expected_tags']} for {str(context['discriminator']).strip(chr(39))!r}"
    if kind == "union_tag_not_found":
        return f"add {str(context['discriminator']).strip(chr(39))!r}; {schema}"
    if kind in ("too_short", "too_long", "string_too_short", "string_too_long"):
        count = context.get("min_length", context.get("max_length"))
        what = "character" if kind.startswith("string") else "item"
        return f"pass at {'least' if 'min_length' in context else 'most'} {count_noun(int(count), what)}"
    if kind == "string_pattern_mismatch":
        return f"use text that matches {context['pattern']}"
    if kind == "value_error":
        return f"use another value; {schema}"
    wanted = KINDS.get(kind.partition("_")[0])
    return f"use {wanted}" if wanted else f"use another value; {schema}"
