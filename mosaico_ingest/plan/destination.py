"""This file asks a destination whether it would take a sequence; it writes nothing there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from pathlib import Path

from mosaico_ingest.config import ServerTarget
from mosaico_ingest.diagnostics import Finding, Severity
from mosaico_ingest.errors import SinkError, Unreachable
from mosaico_ingest.plan.document import DestinationState, Sample
from mosaico_ingest.plan.model import Plan, TopicPlan
from mosaico_ingest.policies import IfExists
from mosaico_ingest.remote.path import RemotePath
from mosaico_ingest.sink import check_same_type
from mosaico_ingest.store.store import Store
from mosaico_ingest.wire import check_topic_name

__all__ = ["ask_destination", "space_finding"]


def ask_destination(plan: Plan, samples: Iterable[Sample], *, connect: bool) -> DestinationState:
    """Return what the destination says; a server is asked only with `connect`."""
    estimated = _estimate(plan, {sample.target: sample for sample in samples})
    if isinstance(plan.target, ServerTarget):
        return _server(plan, plan.target, estimated, connect=connect)
    folder = plan.target.path
    base = None if isinstance(folder, RemotePath) else _base(folder)
    store = None
    try:
        store = Store.find(folder)
        taken = store is not None and _taken(plan, store)
        problem = (base and _refusal_of_folder(base)) or _refusal_of_name(plan, taken=taken)
    except (SinkError, Unreachable) as error:
        taken, problem = None, str(error)
    return DestinationState(
        kind="store",
        exists=store is not None,
        taken=taken,
        problem=problem,
        free_bytes=None if base is None else shutil.disk_usage(base).free,
        estimated_bytes=estimated,
    )


def space_finding(state: DestinationState) -> Finding | None:
    """Return a warning where the rows may not fit the disk."""
    if state.free_bytes is None or state.estimated_bytes is None or state.estimated_bytes <= state.free_bytes:
        return None
    return Finding(
        "disk-space",
        Severity.WARNING,
        f"the rows take {state.estimated_bytes} bytes before compression, and {state.free_bytes} are free",
        help="make room, or name another store in target.store",
    )


def _taken(plan: Plan, store: Store) -> bool:
    """Say whether the name is taken.

    Raises:
        SinkError: Rows of the plan cannot join what is there.
    """
    info = store.find_sequence(plan.sequence)
    if info is None:
        return False
    if plan.if_exists is IfExists.APPEND:
        held = {topic.name: topic.ontology for topic in info.topics}
        for topic in plan.topics:
            name = check_topic_name(topic.target)
            if name in held:
                check_same_type(held[name], topic.ontology, where=topic.target)
    return True


def _base(folder: Path) -> Path:
    """Return the folder itself, or what is there of the way to it."""
    return next(path for path in (folder, *folder.absolute().parents) if path.exists())


def _refusal_of_folder(base: Path) -> str | None:
    if not base.is_dir():
        return f"{base} is no folder"
    return None if os.access(base, os.W_OK | os.X_OK) else f"{base} cannot be written"


def _refusal_of_name(plan: Plan, *, taken: bool) -> str | None:
    if taken and plan.if_exists is IfExists.FAIL:
        return f"there is a sequence {plan.sequence!r}, and sequence.if_exists is fail"
    return None


def _server(plan: Plan, target: ServerTarget, estimated: int | None, *, connect: bool) -> DestinationState:
    taken: bool | None = None
    exists: bool | None = None
    problem: str | None = None
    if connect:
        try:
            taken, exists = _found(plan, target), True
            problem = _refusal_of_name(plan, taken=taken)
        except SinkError as error:
            exists, problem = False, str(error)
    return DestinationState(
        kind="server",
        exists=exists,
        taken=taken,
        problem=problem,
        free_bytes=None,
        estimated_bytes=estimated,
    )


def _found(plan: Plan, target: ServerTarget) -> bool:
    from mosaico_ingest.platform.client import connect  # noqa: PLC0415 - Flight is slow to import and rarely needed

    with connect(target) as client:
        return client.find(plan.sequence) is not None


def _estimate(plan: Plan, samples: dict[str, Sample]) -> int | None:
    """Return what all rows take uncompressed, None where the index or the sample does not say."""
    sizes = [_topic_bytes(topic, samples[topic.target]) for topic in plan.topics if topic.count != 0]
    if any(size is None for size in sizes):
        return None
    return round(sum(size or 0 for size in sizes) * _share(plan))


def _topic_bytes(topic: TopicPlan, sample: Sample) -> int | None:
    if topic.count is None or sample.row_bytes is None:
        return None
    return -(-topic.count // topic.every) * sample.row_bytes


def _share(plan: Plan) -> float:
    """Return how much of the recording's time is read, from 0 to 1."""
    if plan.start_ns is None or plan.end_ns is None or plan.end_ns <= plan.start_ns:
        return 1.0
    start = max(plan.start_ns, plan.read_from_ns if plan.read_from_ns is not None else plan.start_ns)
    end = min(plan.end_ns, plan.read_until_ns if plan.read_until_ns is not None else plan.end_ns)
    return max(0.0, (end - start) / (plan.end_ns - plan.start_ns))
