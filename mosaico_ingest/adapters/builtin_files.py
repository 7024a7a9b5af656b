"""Generate `catalog.json` and the table of built-in adapters in docs/adapters.md."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from mosaico_ingest.adapters.builtin import BUILTIN, CATALOG_FILE, Builtin, find_builtin
from mosaico_ingest.adapters.mapping.loader import load_adapter

__all__ = [
    "catalog_file",
    "catalog_table",
    "with_catalog",
]


def catalog_file() -> str:
    """Return the content of `catalog.json`: one line per adapter.

    Raises:
        AdapterError: An adapter file has a mistake.
    """
    sources = {builtin.stem: load_adapter(builtin.path, adapters=find_builtin).source for builtin in BUILTIN}
    lines = (f'"{stem}": {json.dumps(_plain(source.value))}' for stem, source in sources.items())
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _plain(value: Any) -> Any:  # noqa: ANN401 - whatever YAML can say
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if not isinstance(value, dict):
        return value
    pairs = [(key, _plain(item)) for key, item in value.items()]
    return dict(pairs) if all(isinstance(key, str) for key in value) else {"": pairs}


_BEGIN, _END = "<!-- catalog: made from its files -->\n", "<!-- end of catalog -->\n"


def catalog_table() -> str:
    """Return Markdown tables of the built-in adapters: first the defaults, then those that need an override."""
    used = _table([builtin for builtin in BUILTIN if builtin.default])
    named = _table([builtin for builtin in BUILTIN if not builtin.default])
    return f"{used}\nOnly where an override names them:\n\n{named}"


def with_catalog(text: str) -> str:
    """Return a document with the table between its two markers regenerated."""
    before, rest = text.split(_BEGIN)
    return f"{before}{_BEGIN}\n{catalog_table()}\n{_END}{rest.split(_END)[1]}"


def _table(builtins: list[Builtin]) -> str:
    rows = "".join(
        f"| `{builtin.name}` | {_types(builtin.ros_types)} | `{builtin.tag}` | {builtin.mapping.model.description} |\n"
        for builtin in builtins
    )
    return f"| adapter | ROS types | ontology | |\n|---|---|---|---|\n{rows}"


def _types(names: tuple[str, ...]) -> str:
    """Return type names grouped by package, such as `sensor_msgs: Imu`."""
    packages: dict[str, list[str]] = {}
    for name in names:
        package, _, short = name.partition("/msg/")
        packages.setdefault(package, []).append(short)
    return "; ".join(f"{package}: {', '.join(shorts)}" for package, shorts in packages.items())


if __name__ == "__main__":
    CATALOG_FILE.write_text(catalog_file(), encoding="utf-8")
    path = Path(sys.argv[1])
    path.write_text(with_catalog(path.read_text("utf-8")), "utf-8")
