"""The writing part of a run: move message blocks into a session of the sink, commit or discard it, verify the result."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, cast

from msgspec import Struct

from mosaico_ingest.destinations import (
    AmendableSink,
    AttachableSession,
    Attached,
    Session,
    Sink,
    StoredTopic,
    destination_of,
)
from mosaico_ingest.errors import BagError, IngestError, Interrupted, NothingMatched, VerificationError
from mosaico_ingest.findings import Finding, Severity, Stage
from mosaico_ingest.interrupts import DeferredInterrupt
from mosaico_ingest.job.values import IfExists, OnFailure, SessionLevelErrorPolicy
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.provenance import SequenceRequest
from mosaico_ingest.pipeline.rejections import Quarantine
from mosaico_ingest.pipeline.selection import latched_blocks, row_selector
from mosaico_ingest.pipeline.topic import TopicPipeline, link_outputs, pipelines_by_connection
from mosaico_ingest.pipeline.write_buffer import WriteBuffer
from mosaico_ingest.report.events import (
    CommitStarted,
    Noted,
    Observer,
    Quarantined,
    Rejected,
    TopicClosed,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.parts import Step, Stopwatch
from mosaico_ingest.rosbag.blocks import UnreadableRange
from mosaico_ingest.rosbag.recording import DAMAGE_HELP, Recording, damage_error

if TYPE_CHECKING:
    from mosaico_ingest.pipeline.contract import ContractRun

_SHOWN_FIELDS = 8
"""Number of undeclared fields that a finding names."""


class Written(Struct, frozen=True):
    """The result of a session that ended; `verify` checks it once the session is committed."""

    session: Session
    topics: tuple[TopicPipeline, ...]
    quarantine: Quarantine | None
    if_exists: IfExists
    missing: tuple[str, ...] = ()
    """One line per topic with messages that the index promises and that were neither read nor unreadable."""
    failure: BaseException | None = None
    """The error after which the session policy kept the rows accepted so far."""


def write_sequence(
    plan: Plan,
    request: SequenceRequest,
    recording: Recording,
    sink: Sink,
    *,
    observe: Observer,
    stopwatch: Stopwatch,
    interrupt: DeferredInterrupt,
) -> Written:
    """Pump every message of the plan into the sink and end the session, or discard it as the session policy demands.

    Signals are deferred from the end of the reading on.

    `CommitStarted` precedes every commit: an observer that raises, such as that of a worker whose parent process is gone,
    discards the session.

    Raises:
        IngestError: The run ended early and its session was discarded.
    """
    topics: tuple[TopicPipeline, ...] = ()
    missing: list[str] = []
    failure: BaseException | None = None
    quarantine = _open_quarantine(plan, request)
    buffer = WriteBuffer(max_bytes=plan.memory.queue_bytes)
    try:
        with _open_session(plan, request, sink) as session:
            topics = _open_topics(
                plan, recording, session, observe, quarantine=quarantine, stopwatch=stopwatch
            )
            contract = _start_contract(plan, recording, topics)
            reported = frozenset(recording.unreadable)
            try:
                _attach_files(plan, recording, session, observe)
                _pump(plan, recording, topics, buffer, stopwatch, contract=contract)
                _report_reading(recording, topics, observe, reported=reported)
                missing = check_counts(plan, recording, topics, observe)
                if contract is not None:
                    contract.conclude(request, session, observe)
                if not any(topic.rows for topic in topics):
                    _open_empty_topics(plan, recording, topics, session, observe)
                observe(CommitStarted())
            except BaseException as error:
                failure = _as_interrupt(error)
                if not _keeps_partial(plan, request, failure, rows=buffer.written_rows):
                    raise failure from error
                session.note_error(str(failure))
                observe(CommitStarted())
            if quarantine is not None:
                quarantine.close()
            if not isinstance(failure, Interrupted):
                interrupt.defer()  # a signal from here on waits for the commit
    except BaseException as error:
        # If the commit of a partial result fails too, the first error is the cause, as on a full disk.
        cause = _as_interrupt(error) if failure is None else failure
        _discard(topics, quarantine, cause, observe)
        if cause is error:
            raise
        raise cause from error
    return Written(session, topics, quarantine, request.if_exists, tuple(missing), failure)


def verify(written: Written, commit_error: Exception | None, observe: Observer) -> None:
    """Close every topic in the report and compare the destination with the rows that were written.

    Raises:
        Exception: `commit_error`, or the earlier error after which a partial result should have been kept.
        IngestError: The error after which a partial result was kept.
        VerificationError: The destination does not have the rows that were written, or messages are missing.
    """
    if commit_error is not None:
        cause = written.failure or commit_error
        _discard(written.topics, written.quarantine, cause, observe)
        raise cause from commit_error
    if written.quarantine is not None:
        _report_quarantine(written.quarantine, written.if_exists, observe)
    stored = {topic.topic: topic for topic in written.session.stored()}
    problems = list(written.missing)
    for topic in written.topics:
        content = stored.get(topic.plan.target)
        if written.failure is not None:
            # Rows that were still in the write buffer are not stored; that is no difference to report.
            _subtract(
                topic,
                content.rows if content else 0,
                f"not written before the run ended: {written.failure}",
                observe,
            )
        else:
            problems += _difference(topic, content)
        observe(
            TopicClosed(
                topic.plan.target,
                topic.status,
                content.stored_bytes if content else 0,
                topic.error,
                topic.timeline.report(),
                content.checksum if content else None,
            )
        )
    if written.failure is not None:
        raise written.failure
    if problems:
        raise VerificationError(
            "; ".join(problems),
            hint="the stored sequence is incomplete; replace it, and report this as a bug",
        )


def check_counts(
    plan: Plan, recording: Recording, topics: tuple[TopicPipeline, ...], observe: Observer
) -> list[str]:
    """Compare the number of messages read with the index; return one line per topic with unexplained differences."""
    if plan.read_from_ns is not None or plan.read_until_ns is not None:
        return []
    unreadable = Counter[int]()
    for item in recording.unreadable:
        if item.connection is not None:
            unreadable[item.connection] += item.count or 0
    any_unknown = any(item.connection is None or item.count is None for item in recording.unreadable)
    missing: list[str] = []
    for topic in topics:
        if topic.plan.shares_messages:
            continue
        target, promised = topic.plan.target, topic.plan.count
        accounted = topic.read + sum(unreadable[connection] for connection in topic.plan.connections)
        if promised is None or promised == accounted:
            continue
        text = f"{target}: the index promises {promised} messages, {topic.read} were read"
        if promised < accounted:
            observe(Noted(Finding("unexpected-messages", Severity.WARNING, text)))
        elif any_unknown:
            observe(Unreadable(target, promised - accounted, None, "the messages are in unreadable ranges"))
        else:
            missing.append(f"{text} and no unreadable range explains the difference")
    return missing


def _start_contract(
    plan: Plan, recording: Recording, topics: tuple[TopicPipeline, ...]
) -> ContractRun | None:
    if plan.contract is None:
        return None
    from mosaico_ingest.pipeline.contract import ContractRun  # noqa: PLC0415 - only contracts need it

    return ContractRun.start(plan, recording, topics)


def _open_session(plan: Plan, request: SequenceRequest, sink: Sink) -> AbstractContextManager[Session]:
    if plan.contract is not None and destination_of(plan.destination).can_amend:
        amendable = cast("AmendableSink", sink)
        return amendable.open(request.name, request.metadata, if_exists=request.if_exists, amendable=True)
    return sink.open(request.name, request.metadata, if_exists=request.if_exists)


def _open_quarantine(plan: Plan, request: SequenceRequest) -> Quarantine | None:
    if plan.quarantine is None:
        return None
    counts = [topic.count for topic in plan.read_topics]
    promised = None if None in counts else sum(count or 0 for count in counts)
    return Quarantine(plan.quarantine, plan.sequence.name, promised, name=request.quarantine_file)


def _open_topics(
    plan: Plan,
    recording: Recording,
    session: Session,
    observe: Observer,
    *,
    quarantine: Quarantine | None,
    stopwatch: Stopwatch,
) -> tuple[TopicPipeline, ...]:
    connections = {connection.id: connection for connection in recording.connections}
    topics: list[TopicPipeline] = []
    for topic_plan in plan.topics:
        topic = TopicPipeline(
            topic_plan,
            plan.on_error.message,
            session,
            observe,
            quarantine=quarantine,
            stopwatch=stopwatch,
            selector=row_selector(plan, topic_plan),
            range_start_ns=plan.read_from_ns,
        )
        for connection in topic_plan.connections:
            topic.bind(connections[connection])
        topics.append(topic)
    link_outputs(topics)
    return tuple(topics)


def _pump(
    plan: Plan,
    recording: Recording,
    topics: tuple[TopicPipeline, ...],
    buffer: WriteBuffer,
    stopwatch: Stopwatch,
    *,
    contract: ContractRun | None,
) -> None:
    """Move every message block of the recording through its topic; a thread of the buffer writes the rows."""
    by_connection = pipelines_by_connection(topics)
    try:
        _process(plan, recording, by_connection, buffer, stopwatch, contract=contract)
    finally:
        stopwatch.lap(Step.WAIT)
        stopwatch.add(Step.WRITE, buffer.busy_s)


def _process(
    plan: Plan,
    recording: Recording,
    topics: Mapping[int, TopicPipeline],
    buffer: WriteBuffer,
    stopwatch: Stopwatch,
    *,
    contract: ContractRun | None,
) -> None:
    with buffer:
        stopwatch.lap(Step.PREPARE)
        for block in latched_blocks(plan, recording, lambda block: topics[block.connection].times_of(block)):
            topics[block.connection].process(block, buffer, latched=True)
        blocks = recording.message_blocks(
            tuple(topics),
            start_ns=plan.log_range[0],
            end_ns=plan.log_range[1],
            memory_bytes=plan.memory.read_bytes,
            observe=None if contract is None else contract.observe_order,
        )
        for block in blocks:
            stopwatch.lap(Step.READ)
            topics[block.connection].process(block, buffer)
            stopwatch.lap(Step.ADAPT)
        stopwatch.lap(Step.READ)


def _report_reading(
    recording: Recording,
    topics: tuple[TopicPipeline, ...],
    observe: Observer,
    *,
    reported: frozenset[UnreadableRange],
) -> None:
    """Report padded messages, unreadable ranges, and ranges that were recovered in another way.

    Findings of the recording describe the ranges in `reported` already, so their recovery is not reported twice.
    """
    for topic in topics:
        if topic.padded:
            observe(Noted(_padded(topic)))
        if topic.undeclared:
            observe(Noted(_undeclared(topic)))
    targets = {key: topic.plan.target for key, topic in pipelines_by_connection(topics).items()}
    for item in recording.unreadable:
        if item.connection is not None and item.connection not in targets:
            continue  # the topic is not selected
        if item.count != 0:
            target = None if item.connection is None else targets[item.connection]
            observe(
                Unreadable(
                    target, item.count, item.offset, item.reason, item.start_ns or None, item.end_ns or None
                )
            )
        elif item not in reported:
            message = f"{item.file} at {item.offset}: {item.reason}"
            observe(Noted(Finding("recovered-range", Severity.INFO, message)))


def _padded(topic: TopicPipeline) -> Finding:
    return Finding(
        "padded-messages",
        Severity.WARNING,
        f"{topic.plan.topic}: {topic.padded} messages end in 4 to 7 zero bytes that {topic.plan.msgtype} does not"
        " explain",
        help="check that the messages were written with this definition",
    )


def _undeclared(topic: TopicPipeline) -> Finding:
    names = sorted(topic.undeclared)
    more = f" and {len(names) - _SHOWN_FIELDS} more" if len(names) > _SHOWN_FIELDS else ""
    return Finding(
        "undeclared-fields",
        Severity.WARNING,
        f"{topic.plan.topic}: {topic.plan.msgtype} does not declare {', '.join(names[:_SHOWN_FIELDS])}{more};"
        " they are not stored",
        help="add them to the JSON Schema of the channel",
    )


def _attach_files(plan: Plan, recording: Recording, session: Session, observe: Observer) -> None:
    """Store the attachments of a plan. A damaged attachment is not stored, but reported as a finding.

    Raises:
        SinkError: An attachment cannot be written.
    """
    if not plan.attachments or not destination_of(plan.destination).can_attach:
        return
    attachable = cast("AttachableSession", session)  # as `can_attach` promises
    for attachment in plan.attachments:
        file = Attached(attachment.name, attachment.media_type, attachment.log_ns, attachment.create_ns)
        try:
            attachable.attach(file, recording.attachment_chunks(attachment))
        except BagError as error:
            message = f"the attachment {attachment.name!r} is not stored: {error.what}"
            observe(Noted(Finding("damaged-record", Severity.WARNING, message, help=DAMAGE_HELP)))


def _open_empty_topics(
    plan: Plan,
    recording: Recording,
    topics: tuple[TopicPipeline, ...],
    session: Session,
    observe: Observer,
) -> None:
    """Open the topics of a part without rows, which is stored so that `status` and later runs recognize it.

    Raises:
        IngestError: The recording is not split: an empty sequence would look like an ingested one.
    """
    where = str(plan.files[0])
    read = sum(topic.read for topic in topics)
    if read == 0:
        damage = damage_error(recording, "message")
        if damage is not None and any(gap.count != 0 for gap in recording.unreadable):
            raise damage
        in_window = plan.read_from_ns is not None or plan.read_until_ns is not None
        scope = "in the time range" if in_window else "on the selected topics"
        what = f"there is no message {scope}"
    elif read == sum(topic.dropped for topic in topics):
        what = f"the settings of the topics and the time range drop all of {read} messages"
    else:
        reason = next((topic.error for topic in topics if topic.error), "see the report for the reasons")
        raise IngestError(f"all of {read} messages were rejected", where=where, hint=reason)
    if plan.part is None:
        raise NothingMatched(what, where=where, hint="nothing was written")
    observe(Noted(Finding("empty-part", Severity.INFO, f"{plan.sequence.name} has no rows: {what}")))
    for topic in plan.topics:
        session.topic(topic.target, topic.ontology, topic.metadata)


def _keeps_partial(plan: Plan, request: SequenceRequest, failure: BaseException, *, rows: int) -> bool:
    """Return whether the rows that the destination accepted before an error are committed; without rows, nothing is.

    The sink refuses a partial result that would replace a stored sequence; see `Session.note_error`. A stopped `append`
    is discarded, so that repeating the command does not append the same rows twice.
    """
    if plan.contract is not None and plan.contract.expect.on_failure is not OnFailure.WARN:
        return False  # an incomplete recording cannot fulfill its contract
    if isinstance(failure, Interrupted) and request.if_exists is IfExists.APPEND:
        return False
    return plan.on_error.session is SessionLevelErrorPolicy.Report and rows > 0


def _as_interrupt(error: BaseException) -> BaseException:
    """Return Ctrl-C as `Interrupted` and any other error unchanged."""
    if isinstance(error, KeyboardInterrupt):
        return Interrupted(
            "stopped before the end of the recording", hint="run the same command again to complete it"
        )
    return error


def _discard(
    topics: tuple[TopicPipeline, ...], quarantine: Quarantine | None, error: BaseException, observe: Observer
) -> None:
    """Discard the quarantine and account for the rows of a session that was discarded."""
    if quarantine is not None:
        quarantine.discard()
    cause = error.what if isinstance(error, IngestError) else str(error)
    for topic in topics:
        _subtract(topic, 0, f"the session was discarded: {cause}", observe)
        observe(TopicClosed(topic.plan.target, topic.status, 0, error=topic.error))


def _report_quarantine(quarantine: Quarantine, if_exists: IfExists, observe: Observer) -> None:
    """Report the quarantine file of a committed session; retire the files of a session that it replaced."""
    if if_exists is IfExists.REPLACE:
        quarantine.supersede()
    if quarantine.count:
        path = quarantine.messages_path
        finding = Finding(
            "quarantined",
            Severity.WARNING,
            f"{quarantine.count} messages are quarantined in {path}",
            help=f"fix the manifest, then run `ingest replay {path.parent} --manifest JOB.yaml`",
        )
        observe(Noted(finding))
        observe(Quarantined(str(path)))


def _difference(topic: TopicPipeline, content: StoredTopic | None) -> Iterator[str]:
    actual = (content.rows, content.start_ns, content.end_ns) if content else (0, None, None)
    if (topic.rows, topic.start_ns, topic.end_ns) != actual:
        rows, start_ns, end_ns = actual
        yield (
            f"{topic.plan.target}: wrote {topic.rows} rows in [{topic.start_ns}, {topic.end_ns}], "
            f"found {rows} rows in [{start_ns}, {end_ns}]"
        )


def _subtract(topic: TopicPipeline, stored_rows: int, reason: str, observe: Observer) -> None:
    """Count messages whose rows were handed to the sink but are not stored as rejected."""
    rows = topic.rows - stored_rows
    messages = topic.written - topic.messages_in(stored_rows)
    if rows > 0 or messages > 0:
        observe(TopicProgress(topic.plan.target, written=-messages, rows=-rows))
    if messages > 0:
        observe(
            Rejected(
                topic.plan.target,
                Stage.WRITE,
                "not-written",
                messages,
                reason,
                topic.start_ns or 0,
                -1,
                last_log_time_ns=topic.end_ns,
            )
        )
