"""This file writes one message from plain values, the inverse of `deserialize`."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

from mosaico_ingest.bag.batch import Encoding
from mosaico_ingest.bag.definition import Container, Definition, Field
from mosaico_ingest.bag.deserialize import BLOBS, FORMATS
from mosaico_ingest.errors import BagError

__all__ = ["Serializer"]


class Serializer:
    """Writes messages of one definition, little-endian unless told otherwise."""

    def __init__(self, definition: Definition, encoding: Encoding, *, big_endian: bool = False) -> None:
        if encoding is Encoding.OTHER or (encoding is Encoding.ROS1 and big_endian):
            raise BagError(f"{definition.root}: only CDR and little-endian ROS 1 payloads can be written")
        self._definition = definition
        self._cdr = encoding is Encoding.CDR
        self._order = ">" if big_endian else "<"

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message given as `Deserializer.to_dict` gives it.

        Raises:
            BagError: A value is missing or does not fit its field.
        """
        out = bytearray()
        try:
            self._message(out, self._definition.root, values)
        except (struct.error, KeyError, TypeError, ValueError, AttributeError) as error:
            raise BagError(f"the values do not fit {self._definition.root}: {error!r}") from error
        header = b"\x00\x01\x00\x00" if self._order == "<" else b"\x00\x00\x00\x00"
        return (header if self._cdr else b"") + bytes(out)

    def _message(self, out: bytearray, msgtype: str, values: Mapping[str, Any]) -> None:
        fields = self._definition.types[msgtype].fields
        for field in fields:
            self._field(out, field, values[field.name])
        if not fields and self._cdr:
            out.append(0)

    def _field(self, out: bytearray, field: Field, value: Any) -> None:  # noqa: ANN401 - a field's value
        if field.container is Container.SCALAR:
            self._value(out, field, value)
            return
        if field.container is Container.SEQUENCE:
            if field.size and len(value) > field.size:
                raise ValueError(f"{field.name} has {len(value)} elements, at most {field.size} are allowed")
            self._pack(out, "I", len(value))
        elif len(value) != field.size:
            raise ValueError(f"{field.name} has {len(value)} elements instead of {field.size}")
        if field.type in BLOBS:
            out += bytes(value)
        elif field.type in FORMATS:
            self._pack(out, FORMATS[field.type], *value)
        else:
            for element in value:
                self._value(out, field, element)

    def _value(self, out: bytearray, field: Field, value: Any) -> None:  # noqa: ANN401 - a field's value
        if field.is_message:
            self._message(out, field.type, value)
        elif field.type == "string":
            text = value.encode() + b"\0" * self._cdr
            self._pack(out, "I", len(text))
            out += text
        elif field.type == "wstring":
            units = struct.unpack(f"<{len(value.encode('utf-16-le')) // 2}H", value.encode("utf-16-le"))
            self._pack(out, "I", len(units))
            self._pack(out, "I", *units)
        else:
            self._pack(out, FORMATS[field.type], value)

    def _pack(self, out: bytearray, letter: str, *values: Any) -> None:  # noqa: ANN401 - numbers
        if not values:
            return
        if self._cdr:
            size = struct.calcsize(f"<{letter}")
            out += bytes(-len(out) % size)
        out += struct.pack(f"{self._order}{len(values)}{letter}", *values)
