"""The service's OpenAPI document."""

from __future__ import annotations

import re
from typing import Any

from fastapi import FastAPI

from client.wire import ProblemDetails
from server.problems import MEDIA_TYPE

RESPONSES: dict[int | str, dict[str, Any]] = {
    "4XX": {"description": "The request is invalid; see field, value and remedy.", "model": ProblemDetails},
    "5XX": {
        "description": "An internal error occurred, or the service is temporarily unavailable.",
        "model": ProblemDetails,
    },
    422: {"description": "A field has an invalid value.", "model": ProblemDetails},
}
"""Error responses that the OpenAPI document lists for every route."""
PROBLEM = {"$ref": "#/components/schemas/ProblemDetails"}


def simplify_tuples(schema: Any) -> None:
    """Rewrites homogeneous tuples in a JSON schema as fixed-length arrays, in place.

    More tools support `items` than `prefixItems`.
    """
    for part in schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ():
        simplify_tuples(part)
    if isinstance(schema, dict) and schema.get("prefixItems") and "items" not in schema:
        kinds = schema["prefixItems"]
        if isinstance(kinds, list) and all(kind == kinds[0] for kind in kinds):
            schema["items"] = schema.pop("prefixItems")[0]


def first_sentence(text: str) -> str:
    """Returns the first sentence of a text, or its part before a semicolon, without the final punctuation mark.

    >>> first_sentence("Lists all scenes; wakes none. More.")
    'Lists all scenes'
    """
    return re.split(r"[.;](?:\s|$)", " ".join(text.split()), maxsplit=1)[0]


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """Returns the OpenAPI document of the service.

    Extends FastAPI's document with summaries, the media type of errors, and bearer authentication if a token is set.
    """
    token = app.state.settings.token is not None
    if app.openapi_schema is None:
        written = FastAPI.openapi(app)
        for path, operations in written["paths"].items():
            for operation in operations.values():
                operation["summary"] = first_sentence(operation.get("description", operation["summary"]))
                for status in RESPONSES:
                    if str(status) in operation["responses"]:
                        operation["responses"][str(status)]["content"] = {MEDIA_TYPE: {"schema": PROBLEM}}
                if token and path.startswith("/health/"):
                    operation["security"] = []
        for schema in written.get("components", {}).get("schemas", {}).values():
            simplify_tuples(schema)
            for field in schema.get("properties", {}).values():
                if "description" in field:  # descriptions are docstrings, which are wrapped at the line length
                    field["description"] = " ".join(field["description"].split())
        if token:
            schemes = written.setdefault("components", {}).setdefault("securitySchemes", {})
            schemes["bearer"] = {"type": "http", "scheme": "bearer", "description": "The service's SCAS4D_TOKEN."}
            written["security"] = [{"bearer": []}]
    assert app.openapi_schema is not None  # FastAPI.openapi caches its result
    return app.openapi_schema
