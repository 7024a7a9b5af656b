"""The check of `expectation-bounds`: an expectation whose bounds are missing or contradictory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mosaico_ingest.job.expect import Expectation, FieldExpectations
from mosaico_ingest.job.fields import Section
from mosaico_ingest.lint.check import Check, Job, Problem

_BOUNDS = (("min", "max"), ("after", "before"))
_BETWEEN = "between"


def check(job: Job) -> Iterator[Problem]:
    """Report each expectation without a bound, and each whose lower bound exceeds the upper one."""
    if job.manifest.expect is not None:
        yield from _check(job, job.manifest.expect, ("expect",))


def _check(job: Job, section: Section, path: tuple[str | int, ...]) -> Iterator[Problem]:
    if isinstance(section, Expectation):
        yield from _check_bounds(job, section, path)
    for name, value in section:
        yield from _check_values(job, value, (*path, name))


def _check_values(job: Job, value: Any, path: tuple[str | int, ...]) -> Iterator[Problem]:  # noqa: ANN401 - any field
    if isinstance(value, Section):
        yield from _check(job, value, path)
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield from _check_values(job, inner, (*path, key))


def _check_bounds(job: Job, section: Expectation, path: tuple[str | int, ...]) -> Iterator[Problem]:
    fields = type(section).model_fields
    name = ".".join(map(str, path))
    for low_key, high_key in _BOUNDS:
        if low_key not in fields or high_key not in fields:
            continue
        low, high = getattr(section, low_key), getattr(section, high_key)
        if low is None and high is None and not isinstance(section, FieldExpectations):
            hint = f"add {low_key} or {high_key}, or remove the expectation"
            yield Problem(f"{name} has neither {low_key} nor {high_key}", job.key_span(*path), hint)
        elif low is not None and high is not None and low > high:
            message = f"no value fulfills {name}, because {low_key} exceeds {high_key}"
            yield Problem(message, job.span(*path, low_key), "swap the two values")
    if isinstance(section, FieldExpectations):
        yield from _check_fields(job, section, path, name)


def _check_fields(
    job: Job, section: FieldExpectations, path: tuple[str | int, ...], name: str
) -> Iterator[Problem]:
    if not section.model_fields_set - {"severity"}:
        yield Problem(
            f"{name} expects nothing", job.key_span(*path), "add an expectation, such as finite: true"
        )
    if section.between is not None and section.between[0] > section.between[1]:
        message = f"no value fulfills {name}.{_BETWEEN}, because its first number exceeds the second"
        yield Problem(message, job.span(*path, _BETWEEN), "swap the two numbers")


CHECK = Check("expectation-bounds", job=check)
