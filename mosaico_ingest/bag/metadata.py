"""This file reads rosbag2's `metadata.yaml`: a hint about a recording, whose storage decides."""

from __future__ import annotations

from typing import Any

from mosaico_ingest.errors import BagError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.remote.path import AnyPath
from mosaico_ingest.textfile import read_whole

__all__ = ["FILE_NAME", "Metadata", "TopicHint", "read_metadata"]

FILE_NAME = "metadata.yaml"
_LIMIT_BYTES = 16 << 20


@frozen
class TopicHint:
    """What the metadata say of a topic."""

    topic: str
    msgtype: str
    count: int
    serialization_format: str
    qos: str
    """As the storage spells it; empty where this version of the metadata has another form."""


@frozen
class Metadata:
    """The parts of `metadata.yaml` that can be compared with the storage."""

    path: AnyPath
    files: tuple[str, ...]
    message_count: int
    topics: tuple[TopicHint, ...]
    distro: str


def read_metadata(path: AnyPath) -> Metadata:
    """Read a `metadata.yaml` of any version.

    Raises:
        BagError: It is no YAML, or not of rosbag2's shape.
    """
    import yaml  # noqa: PLC0415 - slow to import, and few recordings come with metadata

    try:
        if path.stat().st_size > _LIMIT_BYTES:
            raise BagError(f"larger than {_LIMIT_BYTES} bytes", where=str(path))
        content = yaml.load(read_whole(path), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # noqa: S506 - both are safe loaders, one is fast
        info = content["rosbag2_bagfile_information"]
        return Metadata(
            path,
            tuple(_text(name) for name in info.get("relative_file_paths") or ()),
            int(info.get("message_count") or 0),
            tuple(_topic(entry) for entry in info.get("topics_with_message_count") or ()),
            _text(info.get("ros_distro")),
        )
    except OSError as err:
        raise BagError(f"cannot be read: {err.strerror}", where=str(path)) from err
    except yaml.YAMLError as err:
        raise BagError(f"no YAML: {' '.join(str(err).split())}", where=str(path)) from err
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as err:
        raise BagError(f"not of the shape of rosbag2's metadata: {err}", where=str(path)) from err


def _topic(entry: dict[str, Any]) -> TopicHint:
    about = entry.get("topic_metadata") or entry["topic_and_type"]
    qos = about.get("offered_qos_profiles")
    return TopicHint(
        _text(about["name"]),
        _text(about["type"]),
        int(entry.get("message_count") or 0),
        _text(about.get("serialization_format")),
        qos if isinstance(qos, str) else "",
    )


def _text(value: object) -> str:
    """Return a scalar as text; a list would be spelled out with all that its aliases stand for."""
    if value is None or isinstance(value, (str, int, float)):
        return "" if value is None else str(value)
    raise ValueError(f"a text expected, a {type(value).__name__} found")
