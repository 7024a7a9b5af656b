"""`ingest store sql`: queries over all topics of a store."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mosaico_ingest.cli.console import PlainTable, Terminal, print_json, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, JsonOption, StoreOption
from mosaico_ingest.cli.store_rows import CsvOption
from mosaico_ingest.report.units import count_text, counted

if TYPE_CHECKING:
    import pyarrow as pa

    from mosaico_ingest.destinations.store import Store

CELL_WIDTH = 60
"""Characters of a value in a table."""
DEFAULT_ROWS = 100
"""Rows that are printed as a table."""


def sql(
    query: Annotated[
        str | None,
        typer.Argument(metavar="QUERY", help="One SELECT statement; without it, the tables are listed."),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="Write the result to a .parquet, .csv or .json file."
        ),
    ] = None,
    limit: Annotated[
        int, typer.Option("--limit", "-n", min=1, metavar="N", help="Number of rows to print as a table.")
    ] = DEFAULT_ROWS,
    as_csv: CsvOption = False,
    as_json: JsonOption = False,
    store: StoreOption = DEFAULT_STORE,
) -> None:
    """Query topics with SQL (DuckDB): `SELECT avg(acceleration.z) FROM quickstart_drive.imu`. Read-only.

    A topic such as /gps/fix is the table SEQUENCE."gps/fix" or SEQUENCE.gps_fix.
    """
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.view.pictures import require_suffix
    from mosaico_ingest.view.sql import run_query

    if out is not None:
        require_suffix(out, (".parquet", ".csv", ".json"))
    opened = Store.open(store, create=False)
    if query is None:
        _print_tables(opened, as_json=as_json)
        return
    reader = run_query(opened, query)
    if out is not None:
        rows = _write(reader, out, out.suffix.lower())
        print_line(f"wrote {out}: {counted(rows, 'row')}", stderr=True)
    elif as_csv:
        _write_csv(reader, sys.stdout)
    elif as_json:
        _print_json(reader)
    else:
        _print_table(reader, limit)


def _print_tables(store: Store, *, as_json: bool) -> None:
    from mosaico_ingest.view.sql import table_names

    tables = [
        (f"{_identifier(info.name)}.{_identifier(table_names(info, topic)[-1])}", topic)
        for info in store.sequences()
        for topic in info.topics
    ]
    if as_json:
        print_json(
            [{"table": name, "ontology": topic.ontology.tag, "rows": topic.rows} for name, topic in tables]
        )
        return
    table = PlainTable("table", "ontology", "rows", numbers={"rows"})
    for name, topic in tables:
        table.add_row(name, topic.ontology.tag, count_text(topic.rows))
    Terminal().print(table)


def _identifier(name: str) -> str:
    return name if name.isidentifier() and name.isascii() else '"' + name.replace('"', '""') + '"'


def _print_table(reader: pa.RecordBatchReader, limit: int) -> None:
    from mosaico_ingest.view.texts import scalar_text

    names = reader.schema.names
    rows, has_more = list[tuple[str, ...]](), False
    for batch in reader:
        has_more = has_more or len(rows) + batch.num_rows > limit
        part = batch.slice(0, limit - len(rows))
        rows += zip(
            *([scalar_text(value, CELL_WIDTH) for value in column] for column in part.columns), strict=True
        )
        if has_more:
            break
    table = PlainTable(*names, numbers={field.name for field in reader.schema if _is_number(field.type)})
    for row in rows:
        table.add_row(*row)
    Terminal().print(table)
    if has_more:
        more = "--limit prints more, --out writes all"
        print_line(f"the first {counted(limit, 'row')}; {more}", style="dim", stderr=True)


def _is_number(kind: pa.DataType) -> bool:
    from mosaico_ingest.view.columns import is_number

    return is_number(kind)


def _print_json(reader: pa.RecordBatchReader) -> None:
    from mosaico_ingest.view.texts import json_value

    print_json([json_value(row) for batch in reader for row in batch.to_pylist()])


def _write(reader: pa.RecordBatchReader, path: Path, suffix: str) -> int:
    """Write the result batch by batch, and return its number of rows."""
    import json

    import pyarrow.parquet as pq

    from mosaico_ingest.view.texts import json_value

    rows = 0
    if suffix == ".parquet":
        with pq.ParquetWriter(path, reader.schema, compression="zstd") as writer:
            for batch in reader:
                writer.write_batch(batch)
                rows += batch.num_rows
        return rows
    with path.open("w", encoding="utf-8", newline="") as file:
        if suffix == ".csv":
            return _write_csv(reader, file)
        for batch in reader:
            for row in batch.to_pylist():
                start = ",\n " if rows else "[\n "
                file.write(f"{start}{json.dumps(json_value(row), ensure_ascii=False)}")
                rows += 1
        file.write("\n]\n" if rows else "[]\n")
    return rows


def _write_csv(reader: pa.RecordBatchReader, file: Any) -> int:  # noqa: ANN401 - a text file
    from mosaico_ingest.view.texts import flat_text

    writer = csv.writer(file)
    writer.writerow(reader.schema.names)
    rows = 0
    for batch in reader:
        columns = ([flat_text(value) for value in column.to_pylist()] for column in batch.columns)
        writer.writerows(zip(*columns, strict=True))
        rows += batch.num_rows
    return rows
