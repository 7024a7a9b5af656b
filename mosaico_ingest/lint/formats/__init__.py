"""Findings as text for machines: JSON, SARIF 2.1.0, GitHub annotations, JUnit; the text for people is `cli.render`."""

from __future__ import annotations

from collections.abc import Callable

from mosaico_ingest.lint.engine import LintReport
from mosaico_ingest.lint.formats import github, json, junit, sarif

__all__ = ["FORMATS"]

FORMATS: dict[str, Callable[[LintReport], str]] = {
    "json": json.render,
    "sarif": sarif.render,
    "github": github.render,
    "junit": junit.render,
}
"""Each format by the name `--format` takes."""
