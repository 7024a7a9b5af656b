"""The reader of the rosbags library behind the interface of `ROSLoader`; the reference that tests compare with."""

from __future__ import annotations

import keyword
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces.typing import Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg, get_typestore

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.blocks import Connection, Encoding
from mosaico_ingest.rosbag.definitions.idl import message_type
from mosaico_ingest.rosbag.definitions.model import Container, MessageType, normalize_msgtype
from mosaico_ingest.rosbag.definitions.parser import BYTES

_ERRORS = (
    AnyReaderError,
    TypesysError,
    SerdeError,
    AssertionError,
    ArithmeticError,
    LookupError,
    TypeError,
    ValueError,
)
"""Exceptions that rosbags raises for recordings, definitions and messages that it cannot read."""


class RosbagsRecording:
    """A recording opened with `rosbags.highlevel.AnyReader`."""

    def __init__(
        self,
        paths: Sequence[Path],
        distro: Stores | None = None,
        definitions: Mapping[str, str] | None = None,
    ) -> None:
        """Open the files; `distro` and `definitions` describe types for recordings without embedded definitions.

        Raises:
            BagError: rosbags cannot open the recording.
        """
        store = get_typestore(RosbagsStores((distro or Stores.EMPTY).value))
        try:
            for msgtype, text in (definitions or {}).items():
                store.register(_types_from_text(msgtype, text))
            self._reader = AnyReader(paths, default_typestore=store if store.fielddefs else None)
            self._reader.open()
        except (*_ERRORS, OSError) as error:
            what = (
                f"rosbags cannot open the recording: {' '.join(str(error).split()) or type(error).__name__}"
            )
            raise BagError(
                what, where=str(paths[0]), hint="use the native reader, or set ros_distro"
            ) from error
        self._rosbags_connections = list(self._reader.connections)
        encoding = Encoding.CDR if self._reader.is2 else Encoding.ROS1
        self.connections = tuple(
            Connection(
                number, one.topic, normalize_msgtype(one.msgtype), encoding, one.msgcount, definition=None
            )
            for number, one in enumerate(self._rosbags_connections)
        )

    def close(self) -> None:
        """Close the files. Closing twice is harmless."""
        if self._reader.stack:
            self._reader.close()

    def time_bounds(self) -> tuple[int, int]:
        """Return the log times of the first and last message, nanoseconds since the epoch."""
        return self._reader.start_time, self._reader.end_time - 1

    def payloads(self, connection_ids: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield log time, connection id and payload of each message, by log time.

        Raises:
            BagError: rosbags cannot read a part of the recording.
        """
        selected = [self._rosbags_connections[number] for number in connection_ids]
        ids = {id(connection): number for number, connection in enumerate(self._rosbags_connections)}
        try:
            for connection, log_ns, payload in self._reader.messages(selected):
                yield log_ns, ids[id(connection)], bytes(payload)
        except (*_ERRORS, OSError) as error:
            raise BagError(f"rosbags cannot read the recording: {error}") from error

    def deserializer(self, connection: Connection) -> Callable[[bytes], dict[str, Any]]:
        """Return a function that decodes a payload to a dictionary, and raises DecodeError for invalid bytes."""
        msgtype = self._rosbags_connections[connection.id].msgtype

        def deserialize(payload: bytes) -> dict[str, Any]:
            try:
                message = self._reader.deserialize(payload, msgtype)
                return _to_dict(message, msgtype, self._reader.typestore.fielddefs)
            except _ERRORS as error:
                raise DecodeError(f"rosbags: {error}", rule="decode", where=msgtype) from error

        return deserialize


def _types_from_text(msgtype: str, text: str) -> Typesdict:
    if "module " in text:
        return get_types_from_idl(text)
    return get_types_from_msg(text, msgtype)


def _to_dict(message: object, msgtype: str, types: Typesdict) -> dict[str, Any]:
    """Return the fields of a rosbags message in the form of `serialization.Deserializer.to_dict`."""
    definition: MessageType = message_type(msgtype, types)
    values: dict[str, Any] = {}
    for field in definition.fields:
        value = getattr(message, f"{field.name}_" if keyword.iskeyword(field.name) else field.name)
        if field.is_message:
            if field.container is Container.SCALAR:
                values[field.name] = _to_dict(value, field.type, types)
            else:
                values[field.name] = [_to_dict(item, field.type, types) for item in value]
        elif field.type in BYTES:
            unsigned = np.asarray(value).astype(np.uint8)  # rosbags reads `byte` as a signed number
            if field.container is Container.SEQUENCE:
                values[field.name] = unsigned.tobytes()
            else:
                values[field.name] = unsigned.tolist()
        else:
            values[field.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return values
