"""Planning: the comparison of a job with its recording, and the decisions about each topic."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

from msgspec import Struct

from mosaico_ingest.adapters.adapter import IMAGE_TAG, UnmodeledSpec, source_metadata
from mosaico_ingest.adapters.bridge import Resolution, ROSBridge, outputs_of
from mosaico_ingest.adapters.mapping.loader import MappingSpec
from mosaico_ingest.contracts import Contract
from mosaico_ingest.destinations import destination_of
from mosaico_ingest.display import bytes_text, counted
from mosaico_ingest.errors import AdapterError, BagError, IngestError, NothingMatched
from mosaico_ingest.findings import Finding, Severity, Span, escape_undecodable, suggest_names
from mosaico_ingest.job.fields import TopicGlob, image_settings, marked_fields, values_at
from mosaico_ingest.job.model import Job, JobSettings
from mosaico_ingest.job.values import (
    CUSTOM_DATA_KEY,
    RECORDS_KEY,
    FileNamePattern,
    IfExists,
    LoaderErrorPolicy,
    Selection,
    Unmodeled,
    first_match,
    select,
)
from mosaico_ingest.pipeline.plan import ExcludedTopic, Plan, TopicPlan, digest_of, observed_topics
from mosaico_ingest.pipeline.selection import (
    check_conditions,
    is_static,
    latched_before,
    missing_publish_times,
    part_range,
)
from mosaico_ingest.pipeline.task import MemoryBudget, Task
from mosaico_ingest.rosbag.blocks import Attachment, Connection, Encoding
from mosaico_ingest.rosbag.definitions.linking import ros_shape
from mosaico_ingest.rosbag.definitions.model import Definition, Language
from mosaico_ingest.rosbag.definitions.registry import TypeResolver
from mosaico_ingest.rosbag.discovery import numbering_gaps
from mosaico_ingest.rosbag.encodings import refusal
from mosaico_ingest.rosbag.recording import Recording, no_topics_error

_ROSBAG2_RECORD = "rosbag2"
"""The metadata record with a copy of `metadata.yaml`, whose content exports write again."""


class _KeptContent(Struct, frozen=True):
    """The metadata and attachments that a plan keeps of a recording."""

    metadata: Mapping[str, Any]
    """Metadata of the sequence, under reserved keys."""
    attachments: tuple[Attachment, ...]
    findings: tuple[Finding, ...]


def plan_recording(task: Task, recording: Recording, *, bridge: ROSBridge, resolver: TypeResolver) -> Plan:
    """Return the plan of an open recording.

    Raises:
        NothingMatched: No topic is selected, or the time range excludes every message.
        BagError: The definition of a selected topic is unknown and `on_error.message` is `raise`.
        AdapterError: An adapter does not fit its topic, or a type has no adapter and `adapters.unmodeled` is `fail`;
            `findings` has every such topic.
        ContractError: The metadata violates its schema, or the definitions differ from the lock file.
        ManifestError: An expression of `where`, `on_change` or the data contract does not fit the messages of its topic.
        IngestError: The task is for another plan, or a definition has changed and `on_schema_change` is `fail`.
    """
    job, metadata_findings = _with_metadata(task.job, recording)
    names = tuple(dict.fromkeys(connection.topic for connection in recording.connections))
    selection = select(job.topics, names)
    findings = [*_recording_findings(recording, resolver, selection), *_unmatched(job, selection, names)]
    findings += metadata_findings
    findings += _group_findings(job, recording)
    topics: list[TopicPlan] = []
    excluded: list[ExcludedTopic] = []
    misfits: list[tuple[str, AdapterError]] = []
    for connection in recording.connections:
        try:
            outcome = plan_connection(
                job, connection, selection, bridge, escape_undecodable(recording.files[0].name)
            )
        except AdapterError as error:
            misfits.append((connection.topic, error))
            continue
        if isinstance(outcome, ExcludedTopic):
            excluded.append(outcome)
        else:
            merged = (merge(topics, topic) for topic in outcome)
            findings += [finding for finding in merged if finding is not None]
    if misfits:
        raise _misfit(job, misfits)
    if not topics:
        raise _nothing_selected(job, recording, excluded)
    _check_conditions(job, topics, recording)
    _check_metadata(job, topics)
    contract = _contract(task, job, topics, recording)
    read_from_ns, read_until_ns = part_range(
        job, recording, has_log_times=all(topic.has_log_times for topic in topics)
    )
    findings += () if job.part is None else job.part.findings
    findings += _image_settings(job, topics)
    findings += missing_publish_times(job, recording, topics)
    findings += latched_before(job, topics, recording.start_ns, read_from_ns)
    findings += _interrupted_replacement(job)
    content = _kept_content(job, recording)
    findings += content.findings
    plan = Plan(
        sequence=job.sequence.replace(family=job.family, metadata_from=None, metadata_schema=None),
        files=recording.files,
        container=recording.container,
        source_bytes=recording.size_bytes,
        resolver=resolver,
        destination=job.destination,
        on_error=job.on_error,
        quarantine=job.quarantine,
        memory=MemoryBudget() if job.run.memory is None else MemoryBudget(job.run.memory),
        topics=tuple(topics),
        excluded=tuple(excluded),
        findings=tuple(findings),
        start_ns=recording.start_ns,
        end_ns=recording.end_ns,
        read_from_ns=read_from_ns,
        read_until_ns=read_until_ns,
        part=job.part,
        attachments=content.attachments,
        kept_metadata=content.metadata,
        missing=recording.missing_files,
        attempt=task.attempt,
        contract=contract,
    )
    if job.lock is not None or job.on_schema_change is not None:
        plan = _check_definitions(job, plan, recording)
    _check_digest(plan, task)
    return plan


def _group_findings(job: Job, recording: Recording) -> Iterator[Finding]:
    """Yield findings about the files of a recording that no `metadata.yaml` lists: their group, and missing numbers."""
    if recording.metadata is not None or len(recording.files) == 1:
        return
    group = job.bag.group
    number_of = group.match if isinstance(group, FileNamePattern) else None
    if isinstance(job.bag.path, str) and len(job.paths) > 1:
        first, last = recording.files[0].name, recording.files[-1].name
        yield Finding(
            "grouped-splits",
            Severity.INFO,
            f"{len(recording.files)} files are read as the splits of one recording: {first} to {last}",
            job.span("bag", "group") or job.span("bag", "path"),
            "set bag.group: none if every file is a recording",
        )
    yield from numbering_gaps(recording.files, number_of, from_zero=len(job.paths) == 1)


def _interrupted_replacement(job: Job) -> Iterator[Finding]:
    """Yield a finding if readers do not see the sequence while it is replaced."""
    if job.sequence.if_exists is not IfExists.REPLACE:
        return
    destination = destination_of(job.destination)
    if not destination.replaces_atomically:
        yield Finding(
            "replaced-by-deletion",
            Severity.INFO,
            f"{destination.describe()} cannot swap sequences: if {job.sequence.name} exists, it is deleted before the"
            " new sequence is uploaded",
            job.span("sequence", "if_exists"),
            "if readers must always see one of the two, upload under another name and delete the old sequence afterwards",
        )


def _with_metadata(job: Job, recording: Recording) -> tuple[Job, tuple[Finding, ...]]:
    """Return the job with the metadata from `metadata_from`, and findings about it."""
    if job.sequence.metadata_from is None:
        return job, ()
    from mosaico_ingest.metadata import fill_in_metadata  # noqa: PLC0415 - it loads the YAML parser

    return fill_in_metadata(job, recording)


def _check_conditions(job: Job, topics: Sequence[TopicPlan], recording: Recording) -> None:
    """Raise ManifestError if an expression of `where` or `on_change` does not fit its topic."""
    if any(topic.has_conditions for topic in topics):
        check_conditions(job, topics, recording.connections)


def _contract(task: Task, job: Job, topics: Sequence[TopicPlan], recording: Recording) -> Contract | None:
    """Return the data contract; raise ManifestError if an expression does not fit its topic."""
    contract = Contract.of(job, task.group)
    if contract is not None:
        from mosaico_ingest.contracts.rows import check_expressions  # noqa: PLC0415 - only contracts need it

        check_expressions(contract, recording.connections, observed_topics(topics))
    return contract


def _check_definitions(job: Job, plan: Plan, recording: Recording) -> Plan:
    """Check the definitions with the lock file and with earlier sequences; return the plan, which `on_schema_change` adapts."""
    from mosaico_ingest.pipeline.definition_changes import (  # noqa: PLC0415 - few jobs need it
        check_lock,
        follow_schema_changes,
        lock_of,
    )

    if job.lock is not None:
        check_lock(job.lock, lock_of(plan, recording.connections), recording=str(recording.files[0]))
    return plan if job.on_schema_change is None else follow_schema_changes(plan, job.on_schema_change)


def _check_metadata(job: Job, topics: Iterable[TopicPlan]) -> None:
    """Raise ContractError if metadata violates its schema."""
    settings = job.topic_settings.values()
    if job.sequence.metadata_schema is None and all(entry.metadata_schema is None for entry in settings):
        return
    from mosaico_ingest.metadata import check_metadata_contracts  # noqa: PLC0415 - it loads the YAML parser

    check_metadata_contracts(job, dict.fromkeys(topic.topic for topic in topics))


def plan_connection(
    job: Job, connection: Connection, selection: Selection, bridge: ROSBridge, source_file: str
) -> tuple[TopicPlan, ...] | ExcludedTopic:
    """Return the plan of each output of one connection, or the reason why it is excluded.

    Raises:
        AdapterError: An override does not fit, or the type has no adapter and `adapters.unmodeled` is `fail`.
        BagError: The definition is unknown and `on_error.message` is `raise`.
    """
    if connection.topic not in selection.selected:
        return _not_selected(job, connection, selection)
    if connection.encoding is Encoding.OTHER:
        return _excluded(connection, connection.problem or refusal(connection.attributes.get("encoding", "")))
    if connection.definition is None:
        return _undefined(
            job, connection, connection.problem or f"no definition of {connection.msgtype} is known"
        )
    resolution = _fitting(bridge.resolve(connection.topic, connection.msgtype), connection.definition)
    if resolution.unmodeled and job.adapters.unmodeled is not Unmodeled.KEEP:
        if job.adapters.unmodeled is Unmodeled.FAIL:
            raise AdapterError(
                f"no adapter takes {connection.msgtype}",
                where=connection.topic,
                hint="name an adapter in adapters.override, or set adapters.unmodeled to keep or skip",
            )
        why = f"no adapter takes {connection.msgtype}, and adapters.unmodeled is skip"
        return _excluded(connection, why, job.span("adapters", "unmodeled"))
    definition, settings = connection.definition, job.settings_of(connection.topic)
    first = TopicPlan(
        topic=connection.topic,
        target=settings.rename or connection.topic,
        msgtype=connection.msgtype,
        connections=(connection.id,),
        adapter=resolution.spec,
        why=resolution.why,
        ontology=resolution.spec.bind(definition, ros_shape(definition)).ontology,
        count=connection.count,
        metadata={**settings.metadata, **source_metadata(definition, source_file, topic=connection.topic)},
        on_error=job.on_error.for_topic(connection.topic),
        every=settings.every,
        where=settings.where,
        on_change=settings.on_change,
        rate=settings.rate,
        stamp=settings.stamp,
        time_offset_ns=settings.time_offset,
        latched=_is_latched(job, connection),
        definitions=(_describe_definition(definition),),
    )
    outputs = outputs_of(resolution.spec)
    return tuple(_plan_outputs(first, outputs, definition)) or (first,)


def _plan_outputs(
    first: TopicPlan, outputs: Sequence[MappingSpec], definition: Definition
) -> Iterator[TopicPlan]:
    """Yield the plan of each output of an adapter, named below the topic; only the first one counts its messages."""
    for position, output in enumerate(outputs):
        yield first.replace(
            target=f"{first.target}/{output.output}",
            adapter=output,
            ontology=output.bind(definition, ros_shape(definition)).ontology,
            shares_messages=position > 0,
        )


def _fitting(resolution: Resolution, definition: Definition) -> Resolution:
    """Return the resolution, or the unmodeled one if a built-in adapter does not fit a schema that is not from ROS.

    Only ROS definitions have unique names: any JSON Schema may be called `sensor_msgs/Imu`.
    """
    if resolution.reason != "built-in" or definition.language is Language.ROS:
        return resolution
    try:
        resolution.spec.bind(definition, ros_shape(definition))
    except AdapterError as error:
        why = f"{resolution.spec.name} does not fit: {error.what}; the messages keep their shape"
        return Resolution(UnmodeledSpec(), "unmodeled", why)
    return resolution


def _is_latched(job: Job, connection: Connection) -> bool:
    """Return whether messages of a connection before the time range are included."""
    time = job.bag.time
    if (time.start is None and job.part is None) or not time.include_latched:
        return False
    matches_glob = first_match(time.latched, connection.topic) is not None
    return matches_glob or connection.latched or is_static(connection.topic)


def _describe_definition(definition: Definition) -> str:
    return f"{definition.source.value} {hashlib.sha256(definition.text.encode()).hexdigest()[:16]}"


def _excluded(connection: Connection, why: str, span: Span | None = None) -> ExcludedTopic:
    return ExcludedTopic(
        topic=connection.topic, msgtype=connection.msgtype, count=connection.count, why=why, span=span
    )


def _undefined(job: Job, connection: Connection, why: str) -> ExcludedTopic:
    if connection.count != 0 and job.on_error.message is LoaderErrorPolicy.RAISE:
        raise BagError(why, where=connection.topic)
    return _excluded(connection, why).replace(undefined=connection.count != 0)


def _not_selected(job: Job, connection: Connection, selection: Selection) -> ExcludedTopic:
    position = selection.decided_by[connection.topic]
    if position is None:
        return _excluded(connection, "no pattern of `topics` matches it", job.span("topics"))
    why = f"excluded by {job.topics[position]!r} in `topics`"
    return _excluded(connection, why, job.span("topics", position))


def merge(topics: list[TopicPlan], addition: TopicPlan) -> Finding | None:
    """Add a connection's plan to the topic with the same name and columns, or else as another topic."""
    same_name = [plan for plan in topics if _bare(plan.target) == _bare(addition.target)]
    for position, plan in enumerate(topics):
        same = (plan.topic, plan.target, plan.msgtype) == (addition.topic, addition.target, addition.msgtype)
        if same and plan.ontology == addition.ontology:
            count = None if plan.count is None or addition.count is None else plan.count + addition.count
            topics[position] = plan.replace(
                connections=(*plan.connections, *addition.connections),
                count=count,
                definitions=tuple(dict.fromkeys((*plan.definitions, *addition.definitions))),
                latched=plan.latched or addition.latched,
            )
            return None
    if not same_name:
        topics.append(addition)
        return None
    target = _free_name(addition, {_bare(plan.target) for plan in topics})
    topics.append(addition.replace(target=target))
    rule, message = _clash(same_name[0], addition)
    return Finding(rule, Severity.WARNING, message, help=f"the second one is stored as {target}")


def _clash(first: TopicPlan, second: TopicPlan) -> tuple[str, str]:
    """Return the rule and the message for two topics of one name."""
    if first.topic != second.topic:
        return "name-clash", f"{first.topic} and {second.topic} have one name in the sequence, {first.target}"
    if first.msgtype != second.msgtype:
        return "mixed-types", f"{second.topic} carries {first.msgtype} and {second.msgtype}"
    return "mixed-types", f"{second.topic} carries two definitions of {second.msgtype}"


def _bare(name: str) -> str:
    """Return a topic name without its first slash, which destinations do not distinguish."""
    return name.removeprefix("/")


def _free_name(plan: TopicPlan, used: set[str]) -> str:
    base = f"{plan.target}/{plan.msgtype.rpartition('/')[2]}"
    candidates = (base, *(f"{base}_{number}" for number in range(2, len(used) + 3)))
    return next(name for name in candidates if _bare(name) not in used)


def _recording_findings(
    recording: Recording, resolver: TypeResolver, selection: Selection
) -> Iterator[Finding]:
    """Yield the findings of the recording and of the selected types; `merge` reports two types on a topic."""
    yield from (finding for finding in recording.findings if finding.rule != "mixed-types")
    selected = [connection for connection in recording.connections if connection.topic in selection.selected]
    yield from resolver.findings_about(
        {name for connection in selected if connection.definition for name in connection.definition.types}
    )


def _unmatched(job: Job, selection: Selection, topics: tuple[str, ...]) -> Iterator[Finding]:
    """Yield a finding for each topic name or glob of the job that matches no topic of the recording."""
    for position in selection.unused:
        yield _unmatched_pattern("topics", job.topics[position], topics, job.span("topics", position))
    for position, glob in enumerate(job.bag.time.latched):
        if not any(first_match((glob,), topic) for topic in topics):
            span = job.span("bag", "time", "latched", position)
            yield _unmatched_pattern("bag.time.latched", glob, topics, span, ())
    for field in marked_fields(JobSettings, TopicGlob):
        if not field.is_key:
            continue
        for path, section in values_at(job, field.path):
            for glob in section if isinstance(section, dict) else ():
                if glob != field.marker.default and not any(first_match((glob,), topic) for topic in topics):
                    keys = (field.marker.default,) if field.marker.default else ()
                    yield _unmatched_pattern(".".join(path), glob, topics, job.span(*path, glob), keys)


def _image_settings(job: Job, topics: Iterable[TopicPlan]) -> Iterator[Finding]:
    """Yield a finding for each `image` setting whose pattern applies only to topics that do not become images."""
    images = {
        pattern: image_settings(settings.image).format
        for pattern, settings in job.topic_settings.items()
        if "image" in settings.model_fields_set
    }
    tags: dict[str, dict[str, str]] = {}
    for topic in topics:
        pattern = first_match(images, topic.topic)
        if pattern is not None and images[pattern] != "raw":
            tags.setdefault(pattern, {})[topic.topic] = topic.ontology.tag
    for pattern, by_topic in tags.items():
        if IMAGE_TAG not in by_topic.values():
            topic, tag = next(iter(by_topic.items()))
            yield Finding(
                "image-setting",
                Severity.WARNING,
                f"image: {images[pattern]} has no effect, because {topic} becomes {tag}, not {IMAGE_TAG}",
                job.span("topic_settings", pattern, "image"),
                "remove the setting",
            )


def _unmatched_pattern(
    key: str, glob: str, topics: tuple[str, ...], span: Span | None, keys: tuple[str, ...] = ()
) -> Finding:
    near = get_close_matches(glob.lstrip("!"), (*topics, *keys), n=1, cutoff=0.5)
    return Finding(
        "unmatched-pattern",
        Severity.WARNING,
        f"{key}: {glob!r} matches none of {len(topics)} topics",
        span,
        f"the nearest is {near[0]}" if near else None,
    )


def _misfit(job: Job, misfits: list[tuple[str, AdapterError]]) -> AdapterError:
    """Return one error for all topics whose adapters do not fit."""
    findings: dict[Finding, None] = {}
    for topic, error in misfits:
        glob = first_match(job.adapters.override, topic)
        span = None if glob is None else job.span("adapters", "override", glob)
        message = f"{error.where}: {error.what}" if error.where else error.what
        mismatch = Finding("type-mismatch", Severity.ERROR, message, span, error.hint)
        findings.update(dict.fromkeys(error.findings or (mismatch,)))
    first = misfits[0][1]
    more = f" (and {len(misfits) - 1} more topics)" if len(misfits) > 1 else ""
    return AdapterError(f"{first.what}{more}", where=first.where, hint=first.hint, findings=tuple(findings))


def _nothing_selected(
    job: Job, recording: Recording, excluded: list[ExcludedTopic]
) -> NothingMatched | BagError:
    where = str(recording.files[0])
    if not excluded:
        return no_topics_error(recording)
    if job.topics and all("`topics`" in topic.why for topic in excluded):
        what = f"no topic matches {', '.join(map(repr, job.topics))}"
        hint = _exclusion_hint(job, excluded) or suggest_names(
            {topic.topic for topic in excluded}, job.topics
        )
        span = job.span("topics")
        if span is None:
            return NothingMatched(what, where=where, hint=hint)
        finding = Finding("unmatched-pattern", Severity.WARNING, what, span, hint)
        return NothingMatched(what, where=str(span), hint=hint, findings=(finding,))
    first = excluded[0]
    return NothingMatched(
        f"none of {len(excluded)} topics can be ingested", where=where, hint=f"{first.topic}: {first.why}"
    )


def _exclusion_hint(job: Job, excluded: list[ExcludedTopic]) -> str | None:
    """Return a hint if the topics that a pattern selects are excluded by a later pattern."""
    for position, pattern in enumerate(job.topics):
        matched = [topic.topic for topic in excluded if first_match((pattern,), topic.topic)]
        later = [glob for glob in job.topics[position + 1 :] if glob.startswith("!")]
        for topic in matched:
            exclusion = next((glob for glob in later if first_match((glob[1:],), topic)), None)
            if exclusion is not None:
                return f"put {exclusion!r} before {pattern!r}, because it excludes {topic}"
    return None


def _check_digest(plan: Plan, task: Task) -> None:
    """Raise IngestError if a task is for another plan."""
    if task.plan_digest is None or digest_of(plan.document(folder=task.job.folder)) == task.plan_digest:
        return
    raise IngestError(
        "the recording no longer matches the plan",
        where=str(plan.files[0]),
        hint="list the differences with `ingest plan --check`, then create a new plan",
    )


def _kept_content(job: Job, recording: Recording) -> _KeptContent:
    """Select the metadata and attachments that the sequence keeps, according to `sequence.keep`.

    Raises:
        BagError: The file cannot be read.
    """
    keep = job.sequence.keep
    metadata: dict[str, Any] = {}
    records = {
        name: entries
        for name, entries in (recording.metadata_records() if keep.records else {}).items()
        if name != _ROSBAG2_RECORD and any(fnmatchcase(name, glob) for glob in keep.records)
    }
    if records:
        metadata[RECORDS_KEY] = [
            {"name": name, "entries": [list(entry) for entry in entries.items()]}
            for name, entries in records.items()
        ]
    custom_data = recording.custom_data() if keep.custom_data else {}
    if custom_data:
        metadata[CUSTOM_DATA_KEY] = [list(entry) for entry in custom_data.items()]
    attachments = tuple(
        attachment
        for attachment in (recording.attachments() if keep.attachments else ())
        if any(fnmatchcase(attachment.name, glob) for glob in keep.attachments)
    )
    return _KeptContent(metadata, attachments, tuple(_attachment_findings(job, attachments)))


def _attachment_findings(job: Job, attachments: tuple[Attachment, ...]) -> Iterator[Finding]:
    """Yield a finding if the destination cannot store the attachments."""
    destination = destination_of(job.destination)
    if attachments and not destination.can_attach:
        size = bytes_text(sum(attachment.size_bytes for attachment in attachments))
        yield Finding(
            "attachments-not-stored",
            Severity.WARNING,
            f"{counted(len(attachments), 'attachment')} ({size}) cannot be stored in {destination.describe()}",
            job.span("sequence", "keep", "attachments") or job.span("target"),
            "ingest into a store as well, or set sequence.keep.attachments: []",
        )
