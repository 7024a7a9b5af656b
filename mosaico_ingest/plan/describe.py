"""This file writes a plan down as a document: decisions as data, paths as seen from the manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from os.path import relpath
from pathlib import Path

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.image import PngImageSpec
from mosaico_ingest.adapters.mapping.load import MappingSpec
from mosaico_ingest.adapters.metadata import ROS_METADATA_KEY
from mosaico_ingest.config import Limit, QuarantineSettings, ROSInjectionConfig, StoreTarget
from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.errors import IngestError
from mosaico_ingest.plan.document import Decisions, FilePart, Kept, Note, PlannedTopic, UnreadTopic
from mosaico_ingest.plan.model import LeftOut, Plan, TopicPlan
from mosaico_ingest.remote.path import AnyPath, RemotePath

__all__ = ["check_digest", "decisions", "notes"]


def decisions(plan: Plan, *, folder: Path) -> Decisions:
    """Return what a run of the plan follows; paths are seen from `folder`."""
    target = plan.target
    return Decisions(
        sequence=plan.sequence,
        metadata=dict(plan.metadata),
        files=tuple(
            FilePart(path=_seen_from(folder, path), size_bytes=path.stat().st_size) for path in plan.files
        ),
        container=plan.container,
        start_ns=plan.start_ns,
        end_ns=plan.end_ns,
        read_from_ns=plan.read_from_ns,
        read_until_ns=plan.read_until_ns,
        destination=_seen_from(folder, target.path)
        if isinstance(target, StoreTarget)
        else f"{target.host}:{target.port}",
        if_exists=plan.if_exists,
        on_error=plan.on_error,
        on_message_error=plan.on_message_error,
        quarantine=None if plan.quarantine is None else _kept(plan.quarantine, folder),
        topics=tuple(map(_planned, plan.topics)),
        left_out=tuple(map(_unread, plan.left_out)),
    )


def check_digest(plan: Plan, config: ROSInjectionConfig) -> None:
    """Refuse a plan that is not the one the configuration is for.

    Raises:
        IngestError: It is another one.
    """
    wanted = config.plan_digest
    if wanted is not None and decisions(plan, folder=config.base_dir).digest != wanted:
        raise IngestError(
            "the recording no longer fits the plan",
            where=str(plan.files[0]),
            hint="`ingest plan --check` says how; make a new plan",
        )


def notes(findings: Iterable[Finding]) -> tuple[Note, ...]:
    """Return findings as a document holds them."""
    return tuple(
        Note(
            severity=finding.severity,
            rule=finding.rule,
            message=finding.message,
            place=str(finding.span) if finding.span else None,
            help=finding.help,
        )
        for finding in findings
    )


def _kept(settings: QuarantineSettings, folder: Path) -> Kept:
    def bound(limit: Limit | None) -> int | float | None:
        return None if limit is None else limit.count if limit.share is None else limit.share

    return Kept(
        path=_seen_from(folder, settings.path),
        max=bound(settings.max),
        max_run=bound(settings.max_run),
        systematic=settings.systematic,
    )


def _planned(topic: TopicPlan) -> PlannedTopic:
    return PlannedTopic(
        topic=topic.topic,
        target=topic.target,
        msgtype=topic.msgtype,
        definitions=topic.definitions,
        adapter=_name(topic.adapter),
        adapter_digest=_digest(topic.adapter),
        why=topic.why,
        ontology=topic.ontology.tag,
        fingerprint=topic.ontology.fingerprint,
        serialization_format=topic.ontology.serialization_format.value,
        count=topic.count,
        every=topic.every,
        on_error=topic.on_error,
        metadata={key: value for key, value in topic.metadata.items() if key != ROS_METADATA_KEY},
    )


def _name(spec: AdapterSpec) -> str:
    return f"{spec.name}, then PNG" if isinstance(spec, PngImageSpec) else spec.name


def _unread(topic: LeftOut) -> UnreadTopic:
    return UnreadTopic(topic=topic.topic, msgtype=topic.msgtype, count=topic.count, why=topic.why)


def _digest(spec: AdapterSpec) -> str | None:
    """Return the digest of what an adapter file says, comments and layout aside."""
    if isinstance(spec, PngImageSpec):
        return _digest(spec.inner)
    if not isinstance(spec, MappingSpec):
        return None
    return hashlib.sha256(spec.model.model_dump_json().encode()).hexdigest()[:16]


def _seen_from(folder: Path, path: AnyPath) -> str:
    if isinstance(path, RemotePath):
        return str(path)
    return Path(relpath(path, folder)).as_posix()
