"""Generate `catalog.json` and the table of built-in adapters in docs/adapters.md from the adapter files."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mosaico_ingest.adapters.builtin import CATALOG, CATALOG_FILE, Builtin, builtins_of, find_builtin
from mosaico_ingest.adapters.mapping.loader import load_adapter
from mosaico_ingest.rosbag.definitions.model import group_types

_BEGIN, _END = "<!-- catalog: generated from its files -->\n", "<!-- end of catalog -->\n"


def read_catalog() -> dict[str, Any]:
    """Return the content of each adapter file by the stem of its name, in the order of the adapters' names.

    Raises:
        AdapterError: An adapter file has a mistake.
    """
    sources = [load_adapter(path, adapters=find_builtin).source for path in CATALOG.glob("*.yaml")]
    by_name = sorted(sources, key=lambda source: str(source.at(("adapter",))).lower())
    return {Path(source.file).stem: source.value for source in by_name}


def catalog_file(catalog: dict[str, Any]) -> str:
    """Return the content of `catalog.json`: one line per adapter."""
    lines = (f'"{stem}": {json.dumps(_as_json(file))}' for stem, file in catalog.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def with_catalog(text: str, catalog: dict[str, Any]) -> str:
    """Return a document with the table between its two markers regenerated."""
    before, rest = text.split(_BEGIN)
    return f"{before}{_BEGIN}\n{_tables(builtins_of(catalog))}\n{_END}{rest.split(_END)[1]}"


def _as_json(value: Any) -> Any:  # noqa: ANN401 - any YAML value
    """Return a value for JSON: a mapping with keys that are not text becomes a list of pairs."""
    if isinstance(value, list):
        return [_as_json(item) for item in value]
    if not isinstance(value, dict):
        return value
    pairs = [(key, _as_json(item)) for key, item in value.items()]
    return dict(pairs) if all(isinstance(key, str) for key in value) else {"": pairs}


def _tables(builtins: Sequence[Builtin]) -> str:
    defaults = _table([builtin for builtin in builtins if builtin.default])
    others = _table([builtin for builtin in builtins if not builtin.default])
    return f"{defaults}\nThese adapters apply only to topics whose override names them:\n\n{others}"


def _table(builtins: Sequence[Builtin]) -> str:
    rows = "".join(
        f"| `{builtin.name}` | {group_types(builtin.ros_types)} | `{builtin.tag}` | {builtin.description} |\n"
        for builtin in builtins
    )
    return f"| adapter | ROS types | ontology | |\n|---|---|---|---|\n{rows}"


if __name__ == "__main__":
    content = read_catalog()
    CATALOG_FILE.write_text(catalog_file(content), encoding="utf-8")
    page = Path(sys.argv[1])
    page.write_text(with_catalog(page.read_text("utf-8"), content), "utf-8")
