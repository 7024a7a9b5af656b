"""This file runs a plan: recording, decode, adapt, sink. It decides nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from mosaico_ingest.bag.recording import Recording
from mosaico_ingest.diagnostics import Finding, Severity, Stage
from mosaico_ingest.errors import Interrupted, NothingMatched, VerificationError
from mosaico_ingest.interrupts import DeferredInterrupt
from mosaico_ingest.plan.model import Plan
from mosaico_ingest.policies import IfExists, SessionLevelErrorPolicy
from mosaico_ingest.quarantine.quarantine import Quarantine
from mosaico_ingest.report.events import (
    Noted,
    Observer,
    Quarantined,
    Rejected,
    TopicClosed,
    TopicProgress,
    Unreadable,
)
from mosaico_ingest.report.stopwatch import Step, Stopwatch
from mosaico_ingest.sink import Session, Sink, StoredTopic
from mosaico_ingest.stream import Stream
from mosaico_ingest.write_buffer import WriteBuffer

__all__ = ["inject"]


def inject(
    plan: Plan, recording: Recording, sink: Sink, observe: Observer, watch: Stopwatch | None = None
) -> None:
    """Read what the plan names, adapt it, write it, and check what the destination then holds.

    Raises:
        IngestError: What ended the run; under the `report` policy the rows accepted before it are kept.
        VerificationError: The destination does not hold what was written.
    """
    watch = watch or Stopwatch()
    failure: BaseException | None = None
    missing: list[str] = []
    quarantine = _open_quarantine(plan)
    streams: tuple[Stream, ...] = ()
    try:
        with (
            DeferredInterrupt() as interrupt,
            sink.open(plan.sequence, plan.metadata, if_exists=plan.if_exists) as session,
        ):
            streams = _open_streams(plan, recording, session, observe, quarantine=quarantine, watch=watch)
            try:
                _pump(plan, recording, streams, observe, watch)
                missing = _missing(plan, recording, streams, observe)
                _check_not_empty(plan, streams)
            except BaseException as error:
                # Every way to end early, Ctrl-C too, is the session policy's to judge.
                failure = _as_interrupt(error)
                if plan.on_error is SessionLevelErrorPolicy.Delete or not any(s.rows for s in streams):
                    raise failure from error
                session.note_error(str(failure))
            if quarantine is not None:
                quarantine.close()
            if not isinstance(failure, Interrupted):
                interrupt.defer()  # all is read: a commit that is cut off would lose it
    except BaseException as error:
        reported = _as_interrupt(error)
        _account_for_discard(streams, quarantine, reported, observe)
        if reported is error:
            raise
        raise reported from error
    if quarantine is not None:
        _report_quarantine(quarantine, plan.if_exists, observe)
    wrong = missing + _close(session.stored(), streams, observe, failure=failure)
    if failure is not None:
        raise failure
    _check_stored(wrong, interrupted=interrupt.asked)


def _check_stored(wrong: list[str], *, interrupted: bool) -> None:
    """Raise where the destination does not hold what was written, or an interrupt waited for it."""
    if wrong:
        raise VerificationError(
            "; ".join(wrong), hint="what is stored is incomplete; replace it, and report this as a mistake"
        )
    if interrupted:
        raise Interrupted("stopped; all of this recording is stored")


def _report_quarantine(quarantine: Quarantine, if_exists: IfExists, observe: Observer) -> None:
    """Say what is kept of a session that is committed; what was kept of one it replaced is no longer needed."""
    if if_exists is IfExists.REPLACE:
        quarantine.supersede()
    if quarantine.kept:
        observe(Noted(_kept(quarantine)))
        observe(Quarantined(str(quarantine.messages_path)))


def _account_for_discard(
    streams: tuple[Stream, ...], quarantine: Quarantine | None, error: BaseException, observe: Observer
) -> None:
    """Account for a session that leaves nothing behind."""
    for stream in streams:
        _take_back(stream, stream.rows, f"the session was discarded: {error}", observe)
        observe(TopicClosed(stream.plan.target, stream.status, 0, error=stream.error))
    if quarantine is not None:
        quarantine.discard()


def _open_quarantine(plan: Plan) -> Quarantine | None:
    if plan.quarantine is None:
        return None
    counts = [topic.count for topic in plan.topics]
    promised = None if None in counts else sum(count or 0 for count in counts)
    return Quarantine(plan.quarantine, plan.sequence, promised, name=plan.kept_as)


def _kept(quarantine: Quarantine) -> Finding:
    return Finding(
        "quarantined",
        Severity.WARNING,
        f"{quarantine.kept} messages lie in {quarantine.messages_path}",
        help=f"mend the manifest, then `ingest replay {quarantine.messages_path.parent} --manifest JOB.yaml`",
    )


def _as_interrupt(error: BaseException) -> BaseException:
    """Return Ctrl-C as `Interrupted`, any other error as it is."""
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("stopped before the end of the recording", hint="run the job again for all of it")
    return error


def _open_streams(
    plan: Plan,
    recording: Recording,
    session: Session,
    observe: Observer,
    *,
    quarantine: Quarantine | None,
    watch: Stopwatch,
) -> tuple[Stream, ...]:
    channels = {channel.id: channel for channel in recording.channels}
    streams: list[Stream] = []
    for topic in plan.topics:
        stream = Stream(topic, plan.on_message_error, session, observe, quarantine=quarantine, watch=watch)
        for channel_id in topic.channels:
            stream.bind(channels[channel_id])
        streams.append(stream)
    return tuple(streams)


def _pump(
    plan: Plan, recording: Recording, streams: tuple[Stream, ...], observe: Observer, watch: Stopwatch
) -> None:
    """Move every batch of the recording through its stream, writing on a thread of its own."""
    by_channel = {channel: stream for stream in streams for channel in stream.plan.channels}
    said = frozenset(recording.losses)  # by a finding of the recording itself
    buffer = WriteBuffer(max_bytes=plan.memory_bytes // 4)
    try:
        _feed(plan, recording, by_channel, buffer, watch)
    finally:
        watch.lap(Step.WAIT)
        watch.add(Step.WRITE, buffer.busy_s)
    for stream in streams:
        if stream.padded:
            observe(Noted(_padded(stream)))
    for loss in recording.losses:
        stream = by_channel.get(loss.channel) if loss.channel is not None else None
        if loss.count == 0 and loss in said:
            continue
        if loss.count == 0:
            observe(Noted(Finding("detour", Severity.INFO, f"{loss.file} at {loss.offset}: {loss.reason}")))
        else:
            observe(Unreadable(stream.plan.target if stream else None, loss.count, loss.offset, loss.reason))


def _feed(
    plan: Plan, recording: Recording, streams: Mapping[int, Stream], buffer: WriteBuffer, watch: Stopwatch
) -> None:
    with buffer:
        batches = recording.batches(
            tuple(streams),
            start_ns=plan.read_from_ns,
            end_ns=plan.read_until_ns,
            memory_bytes=plan.memory_bytes // 4,
        )
        watch.lap(Step.PREPARE)
        for batch in batches:
            watch.lap(Step.READ)
            streams[batch.channel.id].feed(batch, buffer)
            watch.lap(Step.ADAPT)
        watch.lap(Step.READ)


def _padded(stream: Stream) -> Finding:
    return Finding(
        "padded-messages",
        Severity.WARNING,
        f"{stream.plan.topic}: {stream.padded} messages end in 4 to 7 zero bytes that {stream.plan.msgtype} does not explain",
        help="they were read; check that the definition is the one they were written with",
    )


def _missing(plan: Plan, recording: Recording, streams: tuple[Stream, ...], observe: Observer) -> list[str]:
    """Hold what was read against what the index promises; return what is nowhere to be found."""
    if plan.read_from_ns is not None or plan.read_until_ns is not None:
        return []
    known = Counter[int]()
    for loss in recording.losses:
        known.update({} if loss.channel is None else {loss.channel: loss.count or 0})
    elsewhere = any(loss.channel is None or loss.count is None for loss in recording.losses)
    wrong: list[str] = []
    for stream in streams:
        target, promised = stream.plan.target, stream.plan.count
        found = stream.seen + sum(known[channel] for channel in stream.plan.channels)
        if promised is None or promised == found:
            continue
        says = f"{target}: the index promises {promised} messages, {stream.seen} were read"
        if promised < found:
            observe(Noted(Finding("more-than-promised", Severity.WARNING, says)))
        elif elsewhere:
            observe(Unreadable(target, promised - found, None, "they lie in what could not be read"))
        else:
            wrong.append(f"{says} and nothing says where the others are")
    return wrong


def _check_not_empty(plan: Plan, streams: tuple[Stream, ...]) -> None:
    """Refuse to commit a sequence without a row: it would look like one that was ingested."""
    if any(stream.rows for stream in streams):
        return
    read = sum(stream.seen for stream in streams)
    where = str(plan.files[0])
    if read == 0:
        window = plan.read_from_ns is not None or plan.read_until_ns is not None
        what = (
            "there is no message in the time window" if window else "there is no message in the topics taken"
        )
        raise NothingMatched(what, where=where, hint="nothing was written")
    why = next((stream.error for stream in streams if stream.error), "see the report for each reason")
    raise NothingMatched(f"none of {read} messages could be ingested", where=where, hint=why)


def _close(
    stored: tuple[StoredTopic, ...],
    streams: tuple[Stream, ...],
    observe: Observer,
    *,
    failure: BaseException | None,
) -> list[str]:
    """Close each stream in the report; return how the destination differs from what was written.

    After a failure, rows that were on their way are no difference: they are taken back from the count.
    """
    held = {topic.topic: topic for topic in stored}
    wrong: list[str] = []
    for stream in streams:
        found = held.get(stream.plan.target)
        rows = found.rows if found else 0
        if failure is not None:
            _take_back(stream, stream.rows - rows, f"not written before the run ended: {failure}", observe)
        elif (stream.rows, stream.start_ns, stream.end_ns) != _held(found):
            wrong.append(
                f"{stream.plan.target}: wrote {stream.rows} rows in [{stream.start_ns}, {stream.end_ns}], "
                f"found {'{} rows in [{}, {}]'.format(*_held(found))}"
            )
        observe(
            TopicClosed(
                stream.plan.target,
                stream.status,
                found.stored_bytes if found else 0,
                stream.error,
                stream.timeline.report(),
                found.checksum if found else None,
            )
        )
    return wrong


def _held(found: StoredTopic | None) -> tuple[int, int | None, int | None]:
    return (found.rows, found.start_ns, found.end_ns) if found else (0, None, None)


def _take_back(stream: Stream, rows: int, why: str, observe: Observer) -> None:
    """Count rows that were handed over but are not there as rejected."""
    if rows > 0:
        observe(TopicProgress(stream.plan.target, written=-rows))
        observe(Rejected(stream.plan.target, Stage.WRITE, "not-written", rows, why, stream.start_ns or 0, -1))
