"""This file writes `catalog.json` from the files of the built-in adapters."""

from __future__ import annotations

import json
from typing import Any

from mosaico_ingest.adapters.builtin import BUILTIN, FILE, find_builtin
from mosaico_ingest.adapters.mapping.load import load_adapter

__all__ = ["catalog_file"]


def catalog_file() -> str:
    """Return the file: a line for each adapter.

    Raises:
        AdapterError: One of them has a mistake.
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


if __name__ == "__main__":
    FILE.write_text(catalog_file(), encoding="utf-8")
