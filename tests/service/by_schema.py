"""Requests that schemathesis makes up from the routes' own description, and whether the answers keep to it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import schemathesis
from fastapi import FastAPI
from hypothesis import HealthCheck, given, settings
from hypothesis import seed as seeded
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.core.failures import FailureGroup

SEED = 8
MODES = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)


@dataclass
class BySchema:
    """What became of them."""

    requests: dict[str, int] = field(default_factory=dict)
    """By route."""
    wrong: list[str] = field(default_factory=list)
    """Answers of 500 and above, undescribed ones, and connections that failed."""


def requests_by_schema(app: FastAPI, url: str, examples: int) -> BySchema:
    """Up to `examples` requests a route and kind (as described, and not) to the server at `url`."""
    found = BySchema()
    schema = schemathesis.openapi.from_dict(app.openapi())
    for result in schema.get_all_operations():
        operation = result.ok()
        found.requests[operation.label] = 0
        for mode in MODES:
            _ask(operation, mode, url, examples, found)
    return found


def _ask(operation: Any, mode: GenerationMode, url: str, examples: int, found: BySchema) -> None:
    @seeded(SEED)
    @settings(max_examples=examples, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(case=operation.as_strategy(generation_mode=mode))
    def one(case: Any) -> None:
        found.requests[operation.label] += 1
        try:
            case.call_and_validate(base_url=url, timeout=20.0)
        except (FailureGroup, OSError) as error:
            found.wrong.append(f"{operation.label}: {error!r}"[:2000])

    try:
        one()
    except Unsatisfiable:  # nothing about this route can be asked wrongly
        if mode is GenerationMode.POSITIVE:
            raise
