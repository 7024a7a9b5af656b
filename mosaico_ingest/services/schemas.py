"""Schemas: lock files of definitions, ontology types for people, and JSON Schemas for editors."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.types as pt
from msgspec import Struct

from mosaico_ingest.adapters.adapter import UnmodeledSpec
from mosaico_ingest.adapters.bridge import ROSBridge
from mosaico_ingest.adapters.builtin import BUILTIN, BY_NAME
from mosaico_ingest.adapters.mapping.columns import format_type, is_list
from mosaico_ingest.adapters.mapping.loader import PLAIN_TYPES
from mosaico_ingest.adapters.mapping.model import adapter_schema
from mosaico_ingest.documents import write_atomically
from mosaico_ingest.errors import ContractError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.model import Job
from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.ontology.registry import MODULES, column_unit, model, ontology_type, tags
from mosaico_ingest.pipeline.compile import lock_path, read_lock_file
from mosaico_ingest.pipeline.definition_changes import (
    LockDifference,
    LockDocument,
    check_lock,
    lock_differences,
    lock_of,
    merge_locks,
    read_lock,
)
from mosaico_ingest.pipeline.planning import plan_recording
from mosaico_ingest.pipeline.task import Task, open_job


class WrittenLock(Struct, frozen=True):
    """A lock file that was written."""

    path: Path
    lock: LockDocument
    differences: tuple[LockDifference, ...]
    """The differences from the previous file; empty for a new file."""
    is_new: bool


def write_lock(manifest: Path, jobs: Sequence[Job]) -> WrittenLock:
    """Write the lock file of a manifest from the recordings of its jobs; an unchanged file is not written.

    Raises:
        ContractError: The recordings differ from each other.
        IngestError: A recording cannot be planned.
    """
    lock = merge_locks([(str(job.paths[0]), _lock_of(job)) for job in jobs])
    path = lock_path(manifest)
    is_new = not path.exists()
    differences: tuple[LockDifference, ...] = ()
    text = lock.text()
    if not is_new:
        previous = read_lock_file(manifest)
        if previous.text == text:
            return WrittenLock(path, lock, (), is_new)
        differences = lock_differences(read_lock(previous), lock)
    write_atomically(path, text)
    return WrittenLock(path, lock, differences, is_new)


def check_locked(manifest: Path, jobs: Sequence[Job]) -> int:
    """Compare the recordings of a manifest's jobs with its lock file; return the number of recordings.

    Raises:
        ContractError: A recording differs; `findings` has the differences of all recordings.
        ManifestError: The lock file does not exist or is invalid.
        IngestError: A recording cannot be planned.
    """
    file = read_lock_file(manifest)
    errors: list[ContractError] = []
    for job in jobs:
        try:
            check_lock(file, _lock_of(job), recording=str(job.paths[0]))
        except ContractError as error:  # noqa: PERF203 - each recording may differ
            errors.append(error)
    if errors:
        findings: dict[Finding, None] = {}
        for error in errors:
            findings.update(dict.fromkeys(error.findings))
        raise ContractError(
            f"{len(errors)} of {len(jobs)} recordings differ from {file.path}",
            hint=errors[0].hint,
            findings=tuple(findings),
        )
    return len(jobs)


def _lock_of(job: Job) -> LockDocument:
    """Return the lock of one recording; the contracts of the job are not checked."""
    sequence = job.sequence.replace(metadata_from=None, metadata_schema=None)
    bare = job.replace(definitions=None, lock=None, expect=None, sequence=sequence, on_schema_change=None)
    bridge = ROSBridge.for_job(bare)
    with open_job(bare) as (recording, resolver):
        plan = plan_recording(Task(bare), recording, bridge=bridge, resolver=resolver)
        return lock_of(plan, recording.connections)


class OntologySummary(Struct, frozen=True):
    """An ontology type in a list."""

    tag: str
    fields: int
    """Number of top-level fields."""
    summary: str
    adapters: tuple[str, ...]
    """The built-in adapters that produce the type."""


class OntologyField(Struct, frozen=True):
    """A field of an ontology type, or a field inside it."""

    name: str
    """The path, such as `acceleration.x`; `transforms[].header` is a field of the elements of a list."""
    type: str
    nullable: bool
    unit: str
    """Empty if the field has no unit."""


class OntologyDescription(Struct, frozen=True):
    """An ontology type with its fields."""

    tag: str
    summary: str
    format: str
    """The serialization format on the platform."""
    fingerprint: str
    """Identifies the columns."""
    adapters: tuple[str, ...]
    """The built-in adapters that produce the type."""
    fields: tuple[OntologyField, ...]
    """All fields, each followed by the fields inside it."""


def known_ontologies(glob: str | None = None) -> tuple[OntologySummary, ...]:
    """Return the ontology types whose tag matches a glob, in alphabetical order."""
    return tuple(
        OntologySummary(tag, ontology_type(tag).struct.num_fields, _summary(tag), _adapters(tag))
        for tag in tags()
        if glob is None or fnmatchcase(tag.lower(), glob.lower())
    )


def describe_ontology(tag: str) -> OntologyDescription:
    """Return an ontology type with all of its fields.

    Raises:
        UnknownTag: No type has the tag; the hint names the nearest tag.
    """
    ontology = ontology_type(tag)
    return OntologyDescription(
        tag,
        _summary(tag),
        ontology.serialization_format.value,
        ontology.fingerprint,
        _adapters(tag),
        tuple(_fields(tag, ontology.struct, "")),
    )


def _summary(tag: str) -> str:
    return (model(tag).__doc__ or "").strip().partition("\n")[0]


def _adapters(tag: str) -> tuple[str, ...]:
    return tuple(builtin.name for builtin in BUILTIN if builtin.tag == tag)


def _fields(tag: str, struct: pa.StructType, prefix: str) -> Iterator[OntologyField]:
    for field in struct:
        path = f"{prefix}{field.name}"
        unit = column_unit(tag, path.replace("[]", ""))
        yield OntologyField(path, format_type(field.type), field.nullable, unit)
        element: Any = field.type  # the stubs of nested types are incomplete
        while is_list(element):
            element, path = element.value_type, f"{path}[]"
        if pt.is_struct(element):
            yield from _fields(tag, element, f"{path}.")


def job_editor_schema() -> dict[str, Any]:
    """Return the JSON Schema of manifests that proposes the names of the built-in adapters."""
    schema = _copy(job_schema())
    override = schema["$defs"]["AdapterSettings"]["properties"]["override"]
    override["additionalProperties"] = _proposing(
        override["additionalProperties"], [*BY_NAME, UnmodeledSpec().name]
    )
    return schema


def adapter_editor_schema() -> dict[str, Any]:
    """Return the JSON Schema of adapter files that proposes ontology tags, types and the names of built-in adapters."""
    schema = _copy(adapter_schema())
    definitions = schema["$defs"]
    for owner in (schema, definitions["Output"]):
        branches = owner["properties"]["ontology"]["oneOf"]
        branches[0] = _proposing(branches[0], MODULES)
    for owner, key, names in (
        ("ValueForm", "use", BY_NAME),
        ("FieldDeclaration", "type", [*PLAIN_TYPES, *MODULES]),
    ):
        properties = definitions[owner]["properties"]
        properties[key] = _proposing(properties[key], names)
    return schema


def _proposing(node: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return a schema of texts that proposes some of them; any other text stays valid."""
    about = {key: node[key] for key in ("description", "default") if key in node}
    accepts = {key: value for key, value in node.items() if key not in about}
    return {**about, "anyOf": [{"enum": list(names)}, accepts]}


def _copy(schema: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(schema))
