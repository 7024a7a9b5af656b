"""Single JSON messages as dictionaries, validated by jsonschema."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from jsonschema.exceptions import best_match
from referencing.exceptions import Unresolvable

from mosaico_ingest.errors import BagError, DecodeError
from mosaico_ingest.rosbag.definitions.model import Definition
from mosaico_ingest.rosbag.encodings.json_schema import json_type, validator_of
from mosaico_ingest.rosbag.encodings.json_types import ANY, JsonType

_MAX_REASON = 200


def columns_of(definition: Definition) -> JsonType:
    """Return the type of the columns of a definition."""
    kind = json_type(definition.text, definition.root) if definition.text.strip() else ANY
    return kind if kind.kind == "struct" else JsonType("struct")


class JsonCodec:
    """Converts single messages of one definition; jsonschema decides whether they are valid."""

    def __init__(self, definition: Definition) -> None:
        self.columns = columns_of(definition)
        text = definition.text
        self._validator = validator_of(text, definition.root) if text.strip() else None

    def to_dict(self, payload: bytes) -> dict[str, Any]:
        """Return the message's fields by name.

        Raises:
            DecodeError: The payload is not a JSON object, violates the schema, or has a value that fits no column.
        """
        return self.read(payload, set())

    def read(self, payload: bytes, undeclared: set[str]) -> dict[str, Any]:
        """Return the message's fields by name, as `to_dict`; add the fields without a column to `undeclared`."""
        try:
            value = json.loads(payload)
        except (ValueError, RecursionError) as error:
            raise DecodeError(f"the message is not JSON: {error}", rule="json-syntax") from None
        if not isinstance(value, dict):
            raise DecodeError(f"the message is not an object: {json.dumps(value)[:80]}", rule="json-syntax")
        self._validate(value)
        return self.columns.to_column(value, "$", undeclared)

    def from_dict(self, values: Mapping[str, Any]) -> bytes:
        """Return the payload of a message in the form that `to_dict` returns.

        Raises:
            BagError: A value cannot be written as JSON.
        """
        try:
            return json.dumps(
                self.columns.to_json(values), ensure_ascii=False, separators=(",", ":")
            ).encode()
        except (TypeError, ValueError, AttributeError) as error:
            raise BagError(f"the values do not match their columns: {error}") from error

    def _validate(self, value: Any) -> None:  # noqa: ANN401 - any JSON value
        if self._validator is None:
            return
        try:
            error: Any = best_match(self._validator.iter_errors(value))
        except (RecursionError, Unresolvable, re.error, ArithmeticError) as reason:
            text = f"the schema cannot be evaluated: {type(reason).__name__}"
            raise DecodeError(text, rule="json-schema") from None
        if error is not None:
            reason = f"{error.json_path}: {error.message}"
            short_reason = reason if len(reason) <= _MAX_REASON else f"{reason[:_MAX_REASON]}…"
            raise DecodeError(f"{short_reason} ({error.validator})", rule="json-schema")
