"""`ROSSequenceExtractor` and `MosaicoToROSLoader`: exports with the signatures of the official bridge."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from typing_extensions import Self

from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import BagError, NothingMatched
from mosaico_ingest.export.export import Definitions, ExportReport, Restorer, export_sequence, restorers_of
from mosaico_ingest.export.sources import ServerSequence, StoreSequence
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.values import DEFAULT_PORT, ServerTarget, Stores
from mosaico_ingest.report.events import log_level
from mosaico_ingest.rosbag.blocks import ROSMessage
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, ROSTypeRegistry, store_of
from mosaico_ingest.rosbag.loader import distro_and_types

if TYPE_CHECKING:
    from mosaico_ingest.destinations.server.client import ServerClient

_SUFFIXES = {"mcap": ".mcap", "sqlite3": ".db3"}
"""Suffix of a ROS 2 recording by storage plugin."""


@dataclass(frozen=True)
class ROSExtractorConfig:
    """The configuration for exporting one sequence of a server to `<saving_path>/<sequence_name>/<sequence_name>.*`.

    `ros_distro` defines the message types of topics that were stored without a definition, with `custom_msgs` in addition. A distro of
    ROS 1 selects a `.bag` file; otherwise `storage_plugin`, a member of the enumeration of rosbags or its name, selects MCAP or SQLite.
    """

    saving_path: Path | str
    sequence_name: str
    host: str = "localhost"
    port: int = DEFAULT_PORT
    topics: Sequence[str] | str | None = None
    log_level: str = "INFO"
    """The level of the logger `mosaico_ingest` during the export, which logs excluded topics and changed values as warnings."""
    mosaico_api_key: str | None = field(default=None, repr=False)
    tls_cert_path: Path | str | None = None
    enable_tls: bool = False
    start_timestamp_ns: int | None = None
    end_timestamp_ns: int | None = None
    """The end of the time range, exclusive."""
    overwrite: bool = False
    """True if an existing file is replaced."""
    dry_run: bool = False
    """True if no file is written; the report then has no messages."""
    ros_distro: Stores | str | None = None
    storage_plugin: Enum | str = "mcap"
    custom_msgs: Sequence[CustomMessages] | None = None
    registry: type[ROSTypeRegistry] | None = None
    """The registry of message types; None selects the process-wide one."""

    @property
    def path(self) -> Path:
        """The path of the recording.

        Raises:
            BagError: The distro or the storage plugin is unknown.
        """
        distro = store_of(self.ros_distro)
        plugin = self.storage_plugin.name if isinstance(self.storage_plugin, Enum) else self.storage_plugin
        suffix = ".bag" if distro and distro.value.startswith("ros1") else _SUFFIXES.get(plugin.lower())
        if suffix is None:
            raise BagError(f"unknown storage plugin {plugin!r}", hint="use mcap or sqlite3")
        return Path(self.saving_path) / self.sequence_name / f"{self.sequence_name}{suffix}"


class ROSSequenceExtractor:
    """Exports the sequence of one configuration."""

    def __init__(self, config: ROSExtractorConfig) -> None:
        self._config = config

    def run(self) -> ExportReport:
        """Write the recording and return the report.

        Raises:
            IngestError: The sequence cannot be read, no topic or message is selected, or the file cannot be written.
        """
        config = self._config
        path = config.path
        target = ServerTarget(
            host=config.host,
            port=config.port,
            api_key=config.mosaico_api_key,
            tls_cert=Path(config.tls_cert_path) if config.tls_cert_path else None,
            tls=config.enable_tls,
        )
        with log_level(config.log_level), connect(target) as client:
            source = ServerSequence(client, config.sequence_name)
            if not config.dry_run:
                path.parent.mkdir(parents=True, exist_ok=True)
            return export_sequence(
                source,
                config.sequence_name,
                path,
                topics=[config.topics] if isinstance(config.topics, str) else config.topics or (),
                start_ns=config.start_timestamp_ns,
                end_ns=config.end_timestamp_ns,
                ros_distro=config.ros_distro,
                custom_msgs=config.custom_msgs or (),
                registry=config.registry or ROSTypeRegistry,
                replace=config.overwrite,
                dry_run=config.dry_run,
            )


class MosaicoToROSLoader:
    """The topics and messages of a sequence in their original types, by log time. Iterate it once or several times.

    Messages are restored as `export_sequence` restores them: see docs/export.md for the fields that can differ.
    """

    def __init__(  # noqa: PLR0917 - the positional parameters of the official SDK
        self,
        m_client: ServerClient | Store,
        typestore_or_distro: Any,  # noqa: ANN401 - also a typestore of rosbags, which only `rosbag` imports
        sequence_name: str,
        topics: str | Sequence[str] | None = None,
        start_timestamp_ns: int | None = None,
        end_timestamp_ns: int | None = None,
    ) -> None:
        """Look up a sequence of a store, or of the server of a client.

        `typestore_or_distro`, a typestore of rosbags, a distro or None, defines the types of topics that were stored
        without a definition. `topics` are topic globs.
        The start is inclusive, the end exclusive.

        Raises:
            SinkError: The sequence does not exist.
            NothingMatched: The patterns select no topic.
        """
        distro, types = distro_and_types(typestore_or_distro)
        store = store_of(distro) or Stores.LATEST
        finder = DefinitionFinder(None if store is Stores.EMPTY else store, types=types)
        self._source = (
            StoreSequence(m_client, sequence_name)
            if isinstance(m_client, Store)
            else ServerSequence(m_client, sequence_name)
        )
        patterns = [topics] if isinstance(topics, str) else list(topics or ())
        candidates = restorers_of(self._source, patterns, Definitions(store, finder))
        self._restorers = {topic.info.name: topic for topic in candidates if isinstance(topic, Restorer)}
        self.rejected_topics: dict[str, str] = {
            topic.topic: topic.excluded for topic in candidates if not isinstance(topic, Restorer)
        }
        """The reason for each selected topic whose messages cannot be restored."""
        self._window = (start_timestamp_ns, end_timestamp_ns)

    @property
    def topics(self) -> list[str]:
        """The topics whose messages are yielded, sorted."""
        return sorted(self._restorers)

    @property
    def filtered_topics(self) -> list[str]:
        """The topics that the patterns do not select, sorted."""
        return sorted({topic.name for topic in self._source.topics} - {*self.topics, *self.rejected_topics})

    @property
    def msg_types(self) -> list[str]:
        """The message types of the topics, sorted."""
        return sorted({restorer.definition.root for restorer in self._restorers.values()})

    @property
    def duration(self) -> int:
        """The time between the first and the last row of the sequence in ns."""
        start_ns, end_ns = self._source.bounds
        return end_ns - start_ns

    def resolve_native_msg_type(self, topic_name: str) -> str | None:
        """Return the message type of a topic; None if its messages cannot be restored."""
        restorer = self._restorers.get(topic_name)
        return None if restorer is None else restorer.definition.root

    def msg_count(self, topic: str | None = None) -> int:
        """Return the number of messages of a topic, or of all topics, in the time range. Reads the times of the rows.

        Raises:
            NothingMatched: The topic has no messages to restore.
        """
        if topic is not None and topic not in self._restorers:
            hint = suggest_names(self.topics, [topic])
            raise NothingMatched(f"the topic {topic!r} is not selected", where=self._source.name, hint=hint)
        names = self.topics if topic is None else [topic]
        batches = (self._source.rows(self._restorers[name].info, *self._window) for name in names)
        return sum(batch.num_rows for rows in batches for batch in rows)

    def __iter__(self) -> Iterator[tuple[str, ROSMessage]]:
        """Yield each message with its topic, by log time.

        Raises:
            SinkError: The sequence cannot be read.
            AdapterError: An adapter in Python fails.
        """
        messages = [self._messages(restorer) for restorer in self._restorers.values()]
        for message in heapq.merge(*messages, key=lambda message: message.bag_timestamp_ns):
            yield message.topic, message

    def _messages(self, restorer: Restorer) -> Iterator[ROSMessage]:
        with closing(self._source.rows(restorer.info, *self._window)) as batches:
            for log_ns, values in restorer.read_values(batches):
                yield ROSMessage(log_ns, restorer.info.name, restorer.definition.root, values)

    def __enter__(self) -> Self:
        """Return the loader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the loader."""
        self.close()

    def close(self) -> None:
        """Do nothing: the client or the store belongs to the caller."""
