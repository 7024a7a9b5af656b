"""The check of `adapter-parameter`: a parameter that an adapter does not have, or a value of another type."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

from mosaico_ingest.adapters.mapping.loader import parameter_problem
from mosaico_ingest.job.fields import ParameterizedAdapter
from mosaico_ingest.lint.check import Check, Job, Problem, load_mapping_source


def check(job: Job) -> Iterator[Problem]:
    """Report each value in `with` that the adapter file does not accept."""
    adapters = job.manifest.adapters
    for *path, adapter in (
        *(("load", position, adapter) for position, adapter in enumerate(adapters.load)),
        *(("override", topic, adapter) for topic, adapter in adapters.override.items()),
    ):
        if not isinstance(adapter, ParameterizedAdapter) or not job.is_expanded(adapter.file):
            continue
        source = load_mapping_source(job.resolve(adapter.file))
        if source is None:
            continue
        parameters = source.at(("parameters",))
        # `isinstance` does not narrow the types of keys and values.
        defaults = cast("dict[str, Any]", parameters) if isinstance(parameters, dict) else {}
        for name, value in adapter.values.items():
            problem, hint = parameter_problem(defaults, name, value)
            if problem is not None:
                span = job.source.span(("adapters", *path, "with", name))
                yield Problem(f"{adapter}: {problem}", span, hint)


CHECK = Check("adapter-parameter", job=check, reads_files=True)
