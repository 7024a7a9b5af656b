"""This file turns `matrix` into combinations: one job for each, with a value for every name."""

from __future__ import annotations

from itertools import product

from mosaico_ingest.manifest.source import Value

__all__ = ["KEY", "MAX_JOBS", "combinations", "variables"]

KEY = "matrix"
MAX_JOBS = 1000
"""How many jobs one manifest may expand to."""


def combinations(document: Value) -> list[dict[str, str]]:
    """Return the variables of each job a document stands for; a single one without any where it has no matrix.

    A mapping of lists is every combination of their values, a list is its items. What the model refuses counts as
    not there, and beyond `MAX_JOBS` there is none.
    """
    matrix = document.get(KEY) if isinstance(document, dict) else None
    if isinstance(matrix, list):
        cells = [variables(item) for item in matrix[:MAX_JOBS]]
    elif isinstance(matrix, dict):
        axes = {str(name): values for name, values in matrix.items() if isinstance(values, list) and values}
        count = 1
        for values in axes.values():
            count *= len(values)
        chosen = product(*axes.values()) if axes and count <= MAX_JOBS else ()
        cells = [variables(dict(zip(axes, values, strict=True))) for values in chosen]
    else:
        cells = []
    return cells or [{}]


def variables(mapping: Value) -> dict[str, str]:
    """Return the variables a mapping gives values to; what is no text or number counts as not there."""
    if not isinstance(mapping, dict):
        return {}
    return {str(name): str(value) for name, value in mapping.items() if isinstance(value, str | int)}
