"""This file judges adapter files: the mapping itself, and the mapping against the definitions that are known."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

from mosaico_ingest.adapters.definitions import KnownTypes
from mosaico_ingest.adapters.mapping.load import MappingSpec, load_adapter
from mosaico_ingest.adapters.reference import KnownAdapters
from mosaico_ingest.bag.definition import Definition
from mosaico_ingest.bag.shape import ros_shape
from mosaico_ingest.diagnostics import Finding, Severity, Span
from mosaico_ingest.errors import AdapterError, BagError
from mosaico_ingest.lint.document import Document

__all__ = ["adapter_findings"]


def adapter_findings(document: Document) -> Iterator[Finding]:
    """Yield what is wrong with an adapter file, once for each place."""
    try:
        spec = load_adapter(document.text, file=document.file, adapters=KnownAdapters(document.folder))
    except AdapterError as error:
        start = Span(document.file, 1, 1, 1, 1)
        yield from error.findings or [Finding("mapping", Severity.ERROR, error.what, start, error.hint)]
        return
    said: set[Span | None] = set()
    for msgtype in spec.ros_types:
        definition = _definition(spec, msgtype)
        found = () if definition is None else spec.check(definition, ros_shape(definition))
        for finding in found:
            if finding.span not in said:
                said.add(finding.span)
                yield finding


def _definition(spec: MappingSpec, msgtype: str) -> Definition | None:
    """Return the definition in the file itself, or else that of a distro; None where there is none."""
    try:
        return _known_types().find(msgtype, spec)
    except BagError:
        return None


@cache
def _known_types() -> KnownTypes:
    return KnownTypes()
