"""The built-in adapters, which are the files in `catalog/`.

Their content is read from `catalog.json`, because parsing the YAML files with the location of every value takes longer
than the rest of a small run. A test compares both.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow as pa
from msgspec import Struct

from mosaico_ingest.adapters.adapter import Adapter
from mosaico_ingest.adapters.mapping.loader import MappingSpec, adapter_from_model
from mosaico_ingest.rosbag.definitions.model import Definition

CATALOG = Path(__file__).parent / "catalog"
CATALOG_FILE = CATALOG.with_suffix(".json")


class Builtin(Struct, frozen=True):
    """A built-in adapter; implements `AdapterSpec`."""

    name: str
    stem: str
    """The name of its file without `.yaml`."""
    tag: str
    """The ontology tag of its records."""
    ros_types: tuple[str, ...]
    default: bool = True
    description: str = ""
    """One line for lists of adapters."""

    @property
    def path(self) -> Path:
        """The path of its file."""
        return CATALOG / f"{self.stem}.yaml"

    @property
    def mapping(self) -> MappingSpec:
        """The content of its file."""
        return _mapping(self.stem)

    def bind(self, definition: Definition, shape: pa.StructType) -> Adapter:
        """Check the mapping against a message definition and compile it.

        Raises:
            AdapterError: The mapping does not fit.
        """
        return self.mapping.bind(definition, shape)


class _BuiltinLookup(Struct, frozen=True):
    """Finds built-in adapters by name, for the mappings that use them."""

    def __call__(self, name: str) -> Builtin | None:
        return BY_NAME.get(name)

    def names(self) -> Iterable[str]:
        return BY_NAME


find_builtin = _BuiltinLookup()


@cache
def _mapping(stem: str) -> MappingSpec:
    return adapter_from_model(_CATALOG[stem], CATALOG / f"{stem}.yaml", adapters=find_builtin)


def _restore_keys(mapping: dict[str, Any]) -> dict[Any, Any]:
    """Return a mapping as in YAML: those with keys that are not text are stored as a list of pairs."""
    return dict(mapping[""]) if "" in mapping else mapping


def builtins_of(catalog: Mapping[str, Mapping[str, Any]]) -> tuple[Builtin, ...]:
    """Return the adapters of a catalog: the content of each file by the stem of its name."""
    return tuple(
        Builtin(
            file["adapter"],
            stem,
            file["ontology"],
            _ros_types(file.get("variants") or file["ros_type"]),
            file.get("default", True),
            file.get("description", ""),
        )
        for stem, file in catalog.items()
    )


def _ros_types(names: str | Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


_CATALOG: dict[str, dict[str, Any]] = json.loads(CATALOG_FILE.read_bytes(), object_hook=_restore_keys)
BUILTIN = builtins_of(_CATALOG)
"""All built-in adapters by name."""
BY_NAME: dict[str, Builtin] = {builtin.name: builtin for builtin in BUILTIN}
BY_TYPE: dict[str, Builtin] = {
    msgtype: builtin for builtin in BUILTIN if builtin.default for msgtype in builtin.ros_types
}
"""The default adapter of each message type."""
