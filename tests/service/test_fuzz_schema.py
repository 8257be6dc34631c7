"""Schemathesis over the OpenAPI document: requests that follow it and requests that do not."""

from __future__ import annotations

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
    unsupported_method,
)

from service.app import create_app

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
    unsupported_method,
]
DETERMINISTIC = settings(
    max_examples=12,
    derandomize=True,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


def operations() -> list[tuple[str, str]]:
    """Path and method of every operation that the document describes."""
    paths = create_app().openapi()["paths"]
    return [(path, method) for path, described in paths.items() for method in described]


@pytest.mark.parametrize(("path", "method"), operations())
def test_every_operation(http, path, method):
    operation = schemathesis.openapi.from_asgi("/openapi.json", http.app)[path][method]

    @DETERMINISTIC
    @given(case=operation.as_strategy())
    def answers_as_described(case: schemathesis.Case) -> None:
        case.call_and_validate(checks=CHECKS)

    answers_as_described()


@pytest.mark.parametrize(("path", "method"), operations())
def test_every_operation_on_what_is_there(http, path, method):
    operation = schemathesis.openapi.from_asgi("/openapi.json", http.app)[path][method]
    version = http.get("/avatars").json()[0]["version"]
    there = {"avatar": "shell", "model": "shell.tshirt", "version": version}

    @DETERMINISTIC
    @given(case=operation.as_strategy())
    def answers_as_described(case: schemathesis.Case) -> None:
        case.path_parameters.update({name: there[name] for name in case.path_parameters})
        response = case.call_and_validate(checks=CHECKS)
        if method == "get" and not case.query:
            assert response.status_code == 200

    answers_as_described()
