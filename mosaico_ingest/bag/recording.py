"""This file opens recordings: one or many files as one sequence of channels and batches."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from types import TracebackType

import pyarrow as pa
from typing_extensions import Self

from mosaico_ingest.bag.batch import Channel, Encoding, Loss, RawBatch
from mosaico_ingest.bag.channels import ChannelTable
from mosaico_ingest.bag.containers.opening import open_part
from mosaico_ingest.bag.containers.packed import inflate_messages
from mosaico_ingest.bag.containers.part import EARLIEST_NS, LATEST_NS, Block, Hole, Loaded, Part, Slab, Want
from mosaico_ingest.bag.definition import Resolver
from mosaico_ingest.bag.discover import Found, discover
from mosaico_ingest.bag.findings import compare
from mosaico_ingest.bag.gather import Gather, compact
from mosaico_ingest.bag.merge import Turn, in_turn
from mosaico_ingest.bag.prefetch import Prefetched
from mosaico_ingest.diagnostics import Finding
from mosaico_ingest.errors import BagError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath, RemotePath

__all__ = ["Recording", "open_recording"]

_SMALL_BYTES = 1 << 20
"""A recording up to this is read in less time than a thread takes to start."""
_THREADS = 3
"""Reading ahead is the third, beside decoding and writing: with fewer processors they are in each other's way."""
_BLOCKS = 4
"""As many blocks fit into the memory, or twice as many where one is read while another is at work."""

ROWS = 1 << 16
MEMORY_BYTES = 64 << 20


def open_recording(paths: AnyPath | Sequence[AnyPath], *, resolve: Resolver) -> Recording:
    """Open a recording: a file, a directory, a `metadata.yaml`, or several of them as one.

    Raises:
        BagError: A path does not exist, is empty, is no recording, or is damaged beyond reading.
    """
    found = discover([paths] if isinstance(paths, Path | RemotePath) else list(paths))
    stack = ExitStack()
    try:
        parts, losses = _open_parts(found.files, stack)
        return Recording(parts, losses, found, resolve, stack)
    except BaseException:
        stack.close()
        raise


def _open_parts(files: Sequence[AnyPath], stack: ExitStack) -> tuple[list[Part], list[Loss]]:
    """Open every file; one of several that cannot be opened is a loss, as a recorder that crashed leaves such."""
    parts: list[Part] = []
    failed: list[BagError] = []
    for file in files:
        try:
            parts.append(open_part(file, stack))
        except BagError as err:  # noqa: PERF203 - each file may fail for itself
            failed.append(err)
    if not parts:
        raise _none_opened(failed)
    kinds = sorted({part.container for part in parts})
    if len(kinds) > 1:
        raise BagError(
            f"the parts of one recording are of different formats: {', '.join(kinds)}",
            where=str(files[0].parent),
            hint="name the files of one format",
        )
    return parts, [Loss(err.where or "", 0, f"this part cannot be opened: {err.what}") for err in failed]


def _none_opened(failed: Sequence[BagError]) -> BagError:
    first = failed[0]
    if len(failed) == 1:
        return first
    what = f"{first.what}; nor can any of the {len(failed) - 1} other parts be opened"
    return BagError(what, where=first.where, hint=first.hint)


@frozen
class _Step:
    """What one block gave, ready to be gathered."""

    part: int
    slabs: list[Slab]
    holes: list[Hole]
    start_ns: int
    next_ns: int


class Recording:
    """What is in a recording, and its messages in batches; a context manager, usable at once."""

    def __init__(
        self,
        parts: Sequence[Part],
        losses: Sequence[Loss],
        found: Found,
        resolver: Resolver,
        stack: ExitStack,
    ) -> None:
        self._parts = parts
        self._stack = stack
        self._table = ChannelTable(parts, resolver)
        self._running: weakref.WeakSet[Generator[RawBatch, None, None]] = weakref.WeakSet()
        self._losses: dict[Loss, None] = dict.fromkeys(losses)
        self.files: tuple[AnyPath, ...] = found.files
        self.missing: tuple[AnyPath, ...] = found.missing
        """Parts that are not there, though the metadata list them; they are among the losses too."""
        self.container: str = parts[0].container
        """`mcap`, `sqlite3` or `ros1`."""
        self.size_bytes: int = sum(file.stat().st_size for file in found.files)
        self.channels: tuple[Channel, ...] = self._table.channels
        self.start_ns: int | None = min((p.start_ns for p in parts if p.start_ns is not None), default=None)
        self.end_ns: int | None = max((p.end_ns for p in parts if p.end_ns is not None), default=None)
        """The last message's time, inclusive."""
        counts = [part.message_count for part in parts]
        self.message_count: int | None = None if None in counts else sum(count or 0 for count in counts)
        for number, part in enumerate(parts):
            self._note(number, part.holes)
        oddities = compare(parts, self.channels, self.losses, found.metadata)
        self._losses |= dict.fromkeys(Loss(str(file), 0, "this part is not there") for file in found.missing)
        self.findings: tuple[Finding, ...] = (*found.findings, *oddities)
        """What to know before reading; what reading itself finds broken is in `losses`."""

    def __enter__(self) -> Self:
        """Return the recording."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Stop what is being read, close the files and remove temporary ones; twice does no harm."""
        for running in list(self._running):
            running.close()
        self._stack.close()

    @property
    def losses(self) -> tuple[Loss, ...]:
        """What could not be read: found when opening, and by every iteration so far."""
        return tuple(self._losses)

    def batches(
        self,
        channel_ids: Collection[int] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
        rows: int = ROWS,
        memory_bytes: int = MEMORY_BYTES,
    ) -> Iterator[RawBatch]:
        """Yield the messages of some channels (None: all) from `start_ns` up to, not including, `end_ns`.

        The batches of a channel follow each other in log time, unless its messages are so much out of order that
        sorting them would take more than about `memory_bytes`. A batch has at most `rows` messages.
        What cannot be read is left out and listed in `losses`.
        """
        ids = (
            frozenset(channel.id for channel in self.channels)
            if channel_ids is None
            else frozenset(channel_ids)
        )
        low = EARLIEST_NS if start_ns is None else start_ns
        high = LATEST_NS + 1 if end_ns is None else end_ns
        ahead = self.size_bytes > _SMALL_BYTES and pa.cpu_count() >= _THREADS
        block_bytes = memory_bytes // (2 * _BLOCKS if ahead else _BLOCKS)
        wants = [
            Want(self._table.keys(number, ids), low, high, block_bytes) for number in range(len(self._parts))
        ]
        gather = Gather(
            {channel.id: channel for channel in self.channels}, rows=rows, memory_bytes=memory_bytes
        )
        running = self._gathered(wants, gather, ahead=ahead)
        self._running.add(running)
        return running

    def _gathered(
        self, wants: Sequence[Want], gather: Gather, *, ahead: bool
    ) -> Generator[RawBatch, None, None]:
        blocks = self._steps(wants)
        with Prefetched(blocks) if ahead else closing(blocks) as steps:
            for step in steps:
                self._note(step.part, step.holes)
                for slab in step.slabs:
                    yield from gather.add(self._table.channel_id(step.part, slab.key), slab, step.start_ns)
                yield from gather.settle(step.next_ns)
            yield from gather.rest()

    def _steps(self, wants: Sequence[Want]) -> Generator[_Step, None, None]:
        """Load block after block; runs in a thread of its own where that pays."""
        sources = [
            (part.start_ns, partial(_blocks, part, want))
            for part, want in zip(self._parts, wants, strict=True)
            if want.keys
        ]
        numbers = [number for number, want in enumerate(wants) if want.keys]
        for turn in in_turn(sources):
            yield self._step(numbers[turn.part], turn)
        for number in numbers:
            self._parts[number].check_unchanged()

    def _step(self, number: int, turn: Turn) -> _Step:
        try:
            loaded = turn.block.load()
        except BagError as err:
            return _Step(number, [], [Hole(0, err.what)], turn.block.start_ns, turn.next_ns)
        slabs = [self._plain(number, slab, loaded.holes) for slab in loaded.slabs]
        compacted = [compact(slab) for slab in slabs if len(slab)]
        return _Step(number, compacted, loaded.holes, turn.block.start_ns, turn.next_ns)

    def _plain(self, number: int, slab: Slab, holes: list[Hole]) -> Slab:
        channel = self.channels[self._table.channel_id(number, slab.key)]
        return inflate_messages(slab, holes) if channel.encoding is Encoding.CDR else slab

    def _note(self, number: int, holes: Sequence[Hole]) -> None:
        for hole in holes:
            channel = None if hole.key is None else self._table.channel_id(number, hole.key)
            loss = Loss(str(self._parts[number].path), hole.offset, hole.reason, channel, hole.count)
            self._losses[loss] = None


def _blocks(part: Part, want: Want) -> Iterator[Block]:
    """Yield the blocks of a part; where it can tell of no more, that is a hole and not the end of the recording."""
    try:
        yield from part.blocks(want)
    except BagError as err:
        hole = Hole(0, err.what)
        yield Block(LATEST_NS, lambda: Loaded([], [hole]))
