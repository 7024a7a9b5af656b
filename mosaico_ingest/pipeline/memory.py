"""The memory budget of a run and its division among the stages that hold messages or rows."""

from __future__ import annotations

from msgspec import Struct

DEFAULT_BYTES = 256 << 20
_MIN_BYTES = 32 << 20
_HOLDERS = 4
"""The reader, the write buffer, the sink, and the batch that is being decoded and adapted."""


class MemoryBudget(Struct, frozen=True):
    """The number of bytes that the messages and rows of one run may occupy; each stage gets an equal share."""

    total_bytes: int = DEFAULT_BYTES

    @property
    def read_bytes(self) -> int:
        """Bytes for message blocks that are read ahead and sorted."""
        return self.total_bytes // _HOLDERS

    @property
    def queue_bytes(self) -> int:
        """Bytes for batches that wait in the write buffer."""
        return self.total_bytes // _HOLDERS

    @property
    def sink_bytes(self) -> int:
        """Bytes for rows that the sink collects before it writes them."""
        return self.total_bytes // _HOLDERS

    def split(self, runs: int) -> MemoryBudget:
        """Return the budget of one of `runs` simultaneous runs, at least 32 MiB."""
        return MemoryBudget(max(self.total_bytes // runs, _MIN_BYTES))
