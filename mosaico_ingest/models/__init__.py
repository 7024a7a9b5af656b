"""The public names of the official `mosaicolabs.models`: the ontology and `Message`.

The submodules `core`, `data`, `sensors` and `futures` have the official names; the models are those of
`mosaico_ingest.ontology`.
"""

from __future__ import annotations

from mosaico_ingest import ontology

__all__: list[str] = []


def __getattr__(name: str) -> object:
    return getattr(ontology, name)


def __dir__() -> list[str]:
    return list(ontology.__all__)
