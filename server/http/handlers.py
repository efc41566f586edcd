"""Exception handlers that convert every error of the application into a problem document."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import compile_path

from client.wire import ProblemDetails
from server.http import validation
from server.http.openapi import openapi_document
from server.problems import Problem, internal_error, problem_response

JSON = re.compile(r"application/([\w.-]+\+)?json")

log = logging.getLogger("scas4d.server")


def install_handlers(app: FastAPI) -> None:
    """Installs the exception handlers in the application."""

    async def from_problem(request: Request, error: Exception) -> Response:
        assert isinstance(error, HTTPException)
        if isinstance(error, Problem):
            return problem_response(error.document, error.headers)
        headers = dict(error.headers or {})
        if error.status_code == 405:  # Starlette lists only the methods of the first route with this path
            headers["Allow"] = ", ".join(allowed_methods(request.app, request.url.path)) or headers.get("Allow", "")
        return problem_response(_framework_problem(request, error.status_code, str(error.detail), headers), headers)

    async def from_validation(request: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        first = error.errors()[0]
        given = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if first["loc"][0] == "body" and given and not JSON.fullmatch(given):
            problem = Problem(
                415,
                f"unsupported body type {given}",
                field="Content-Type",
                value=given,
                remedy="send a body of type application/json",
            )
            return problem_response(problem.document)
        route = request.scope.get("route")
        body = getattr(getattr(route, "body_field", None), "field_info", None)
        problem = validation.validation_problem(
            first,
            model=getattr(body, "annotation", None),
            others=len(error.errors()) - 1,
            text=error.body if isinstance(error.body, str) else None,
        )
        return problem_response(problem.document)

    async def from_fault(request: Request, error: Exception) -> Response:
        log.exception("%s %s failed", request.method, request.url.path, exc_info=error)
        return problem_response(internal_error(error).document)

    app.openapi = lambda: openapi_document(app)  # type: ignore[method-assign]
    app.add_exception_handler(HTTPException, from_problem)
    app.add_exception_handler(RequestValidationError, from_validation)
    app.add_exception_handler(Exception, from_fault)


def allowed_methods(app: FastAPI, path: str) -> list[str]:
    """Returns the HTTP methods that the OpenAPI document lists for a path."""
    return sorted(
        {
            method.upper()
            for template, operations in openapi_document(app)["paths"].items()
            if compile_path(template)[0].match(path)
            for method in operations
        }
    )


def _framework_problem(request: Request, status: int, detail: str, headers: Mapping[str, str]) -> ProblemDetails:
    """Returns the problem document for an error raised by Starlette or FastAPI, such as an unknown path or method."""
    field = value = None
    remedy = "see /openapi.json"
    if status == 404:
        field, value, remedy = "path", request.url.path, "see /openapi.json for all paths"
    elif status == 405:
        field, value, remedy = "method", request.method, f"use {headers.get('Allow') or 'another method'}"
    elif status == 400:
        field, remedy = "body", "send a body that matches its Content-Type; see /openapi.json for the schema"
    return Problem(status, detail, field=field, value=value, remedy=remedy).document
