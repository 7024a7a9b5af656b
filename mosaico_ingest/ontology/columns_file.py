"""Generate `columns.json` from the built-in ontology models."""

from __future__ import annotations

import json

from mosaico_ingest.ontology.registry import COLUMNS_FILE, MODULES, OntologyType, encode_fields, model


def columns_file() -> str:
    """Return the content of the file: one entry per tag, one line per column."""
    entries = (_entry(tag, model(tag).ontology_type()) for tag in sorted(MODULES))
    return "{\n" + ",\n".join(entries) + "\n}\n"


def _entry(tag: str, ontology: OntologyType) -> str:
    columns = ",\n".join(
        f'  "{name}": {json.dumps(kind)}' for name, kind in encode_fields(ontology.struct).items()
    )
    return f' "{tag}": {{"format": "{ontology.serialization_format.value}", "columns": {{\n{columns}\n }}}}'


if __name__ == "__main__":
    COLUMNS_FILE.write_text(columns_file(), encoding="utf-8")
