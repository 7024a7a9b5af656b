"""This file is the plan: every decision about one recording, as frozen data that can be printed, compared and sent."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.bag.definition import Resolver
from mosaico_ingest.config import Attempt, QuarantineSettings, ServerTarget, StoreTarget
from mosaico_ingest.diagnostics import Finding, Span
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.types import OntologyType
from mosaico_ingest.policies import (
    IfExists,
    LoaderErrorPolicy,
    SessionLevelErrorPolicy,
    TopicLevelErrorPolicy,
)
from mosaico_ingest.remote.path import AnyPath

__all__ = ["DEFAULT_MEMORY_BYTES", "LeftOut", "Plan", "TopicPlan"]

DEFAULT_MEMORY_BYTES = 256 * 1024 * 1024


@frozen
class TopicPlan:
    """One stream: the channels it is made of, what it becomes, and why."""

    topic: str
    """Its name in the recording."""
    target: str
    """Its name in the sequence."""
    msgtype: str
    channels: tuple[int, ...]
    adapter: AdapterSpec
    why: str
    """Which rule chose the adapter."""
    ontology: OntologyType
    count: int | None
    """How many messages the index promises."""
    metadata: Mapping[str, Any]
    on_error: TopicLevelErrorPolicy
    every: int = 1
    """Keep the first of each `every` messages."""
    definitions: tuple[str, ...] = ()
    """Where each of its definitions was found, and the digest of its text, as `bag 1f0c9a22b7e4d8a3`."""


@frozen
class LeftOut:
    """A topic of the recording that will not be read, and why."""

    topic: str
    msgtype: str
    count: int | None
    why: str
    span: Span | None = None
    """Where the manifest says so."""
    lost: bool = False
    """Nobody asked for that: its messages cannot be read for want of their definition."""


@frozen
class Plan:
    """What will be done with one recording."""

    files: tuple[AnyPath, ...]
    container: str
    source_bytes: int
    resolver: Resolver
    sequence: str
    metadata: Mapping[str, Any]
    target: StoreTarget | ServerTarget
    if_exists: IfExists
    on_error: SessionLevelErrorPolicy
    on_message_error: LoaderErrorPolicy
    topics: tuple[TopicPlan, ...]
    left_out: tuple[LeftOut, ...] = ()
    findings: tuple[Finding, ...] = ()
    start_ns: int | None = None
    """The first instant of the recording, ns since the epoch."""
    end_ns: int | None = None
    read_from_ns: int | None = None
    """Messages recorded before are not read."""
    read_until_ns: int | None = None
    """Messages recorded at this instant or later are not read."""
    quarantine: QuarantineSettings | None = None
    """Where rejected messages are kept."""
    kept_as: str | None = None
    """The name of the file they are kept in, as the ledger of the run has it."""
    missing: tuple[AnyPath, ...] = ()
    """Parts of the recording that are not there, though its metadata list them."""
    family: str | None = None
    """What the sequences of the same job, for other recordings, have in common."""
    memory_bytes: int = DEFAULT_MEMORY_BYTES
    """How much memory batches may take, from reading to writing."""
    attempt: Attempt | None = None
    """Which try this is, where there may be several."""
