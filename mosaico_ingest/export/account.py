"""This file is what an export did, as people and programs read it."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

__all__ = ["ExportReport", "TopicExport"]


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


class TopicExport(_Record):
    """What became of one topic."""

    topic: str
    msgtype: str = ""
    """`pkg/msg/Name`; empty where the topic does not say."""
    ontology: str
    adapter: str = ""
    """The adapter that was undone; `Unmodeled`: the messages kept their shape."""
    messages: int = 0
    unknown: tuple[str, ...] = ()
    """Fields that are not in the store; they are zero, empty or false in every message."""
    not_undone: dict[str, str] = {}
    """Columns that no field could be computed from, and what they were computed as."""
    changed: dict[str, int] = {}
    """Columns that would come out otherwise if the file were ingested, and in how many rows."""
    left_out: str = ""
    """Why it is not in the file; empty where it is."""

    @property
    def faithful(self) -> bool:
        """Whether the file, ingested in the same way, gives the same rows."""
        return not self.left_out and not self.changed


class ExportReport(_Record):
    """What one export did."""

    sequence: str
    path: str
    bytes: int
    topics: tuple[TopicExport, ...]

    @property
    def messages(self) -> int:
        """How many messages the file holds."""
        return sum(topic.messages for topic in self.topics)

    @property
    def faithful(self) -> bool:
        """Whether every topic is in the file, and gives the same rows again."""
        return all(topic.faithful for topic in self.topics)
