"""`ROSSequenceExtractor`: the export of a sequence of a server with the signature of the official bridge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from mosaico_ingest.destinations.server.client import connect
from mosaico_ingest.errors import BagError
from mosaico_ingest.export.export import ExportReport, export_sequence
from mosaico_ingest.export.sources import ServerSequence
from mosaico_ingest.job.values import DEFAULT_PORT, ServerTarget, Stores
from mosaico_ingest.report.events import log_level
from mosaico_ingest.rosbag.definitions.registry import CustomMessages, ROSTypeRegistry, store_of

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
