"""This file is a job manifest as the rules see it: the model of whatever is right in it, with every place."""

from __future__ import annotations

import json
from collections.abc import Mapping
from copy import deepcopy
from functools import reduce
from pathlib import Path

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from mosaico_ingest.diagnostics import Finding, Span
from mosaico_ingest.frozen import frozen
from mosaico_ingest.manifest.environment import fill_in
from mosaico_ingest.manifest.load import check_manifest
from mosaico_ingest.manifest.model import Manifest
from mosaico_ingest.manifest.problems import place_of
from mosaico_ingest.manifest.source import Path as Place
from mosaico_ingest.manifest.source import Source, Value, member

__all__ = ["Job", "read_job"]

_MISSING = "missing"
"""Stands for a text that must be there and is not, so that the rest can be judged."""


@frozen
class Job:
    """A manifest; what the model refuses is left out of it, and reported by itself."""

    manifest: Manifest
    source: Source
    folder: Path
    """Where its relative paths start."""
    file: Path | None = None
    """The file on disk, if there is one."""

    def span(self, *place: str | int) -> Span:
        """Return the place of a value."""
        return self.source.span(place)

    def key_span(self, *place: str | int) -> Span:
        """Return the place of a key."""
        return self.source.key_span(place)

    def given(self, *place: str | int) -> bool:
        """Say whether the manifest says something there."""
        return place in self.source.spans

    def known(self, text: str | None) -> bool:
        """Say whether a text is there and holds no variable that could not be filled in."""
        return text is not None and "${" not in text and text != _MISSING

    def resolve(self, path: str) -> Path:
        """Return a path as seen from here."""
        return self.folder / Path(path).expanduser()


def read_job(
    source: Source, *, folder: Path, env: Mapping[str, str] | None, file: Path | None = None
) -> tuple[Job | None, tuple[Finding, ...]]:
    """Return the job, as much as there is of it, and what is wrong with its text and its shape."""
    manifest, findings = check_manifest(source, env=env)
    if manifest is None and isinstance(source.value, dict):
        manifest = _salvage(fill_in(source, env).value)
    return (None if manifest is None else Job(manifest, source, folder, file)), findings


def _salvage(value: Value) -> Manifest | None:
    """Take out what the model refuses until the rest holds together."""
    value = deepcopy(value)
    for _ in range(50):
        manifest, refused = _validate(value)
        if manifest is not None:
            return manifest
        for details in refused:
            _take_out(value, details["loc"], missing=details["type"] == "missing")
    return None


def _validate(value: Value) -> tuple[Manifest | None, list[ErrorDetails]]:
    try:
        return Manifest.model_validate_json(json.dumps(value), strict=True), []
    except ValidationError as error:
        return None, error.errors(include_url=False, include_context=False)


def _take_out(value: Value, location: Place, *, missing: bool) -> None:
    """Remove the value at an error's location, or put a stand-in where one is missing; of a list, remove all."""
    place = place_of(location, value)
    holder = reduce(member, place if missing else place[:-1], value)
    if missing and isinstance(holder, dict):
        holder[location[-1]] = {"path": _MISSING} if location == ("bag",) else _MISSING
    elif isinstance(holder, dict) and place:
        del holder[place[-1]]
    elif isinstance(holder, list):
        holder.clear()
