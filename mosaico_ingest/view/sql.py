"""SQL over a store with DuckDB: a schema per sequence, a view per topic, and read-only statements."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.dataset as ds

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.model import SequenceInfo, TopicInfo
from mosaico_ingest.errors import ViewError, missing_library
from mosaico_ingest.remote import RemotePath

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection

MAX_SEQUENCES = 100
"""Number of sequences above which a query sees only the sequences that it names."""
BATCH_ROWS = 10_000
"""Rows per batch of a result."""
_READ_ONLY = frozenset({"SELECT", "EXPLAIN", "MULTI", "RELATION"})
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


def run_query(store: Store, query: str) -> pa.RecordBatchReader:
    """Run one read-only statement and return its result, batch by batch.

    Raises:
        ViewError: The statement is invalid, fails, or would change something.
        IngestError: DuckDB is not installed.
    """
    duckdb = _duckdb()
    read_only(query)
    connection = connect(_named_sequences(store, query))
    try:
        result: Any = connection.sql(query)
        # DuckDB 1 has another name for the method.
        to_reader: Any = getattr(result, "to_arrow_reader", None) or result.fetch_arrow_reader
        return to_reader(BATCH_ROWS)
    except duckdb.Error as error:
        raise _explained(error) from error


def connect(sequences: Iterable[SequenceInfo]) -> DuckDBPyConnection:
    """Return a connection to a database in memory with a view for each topic of the sequences.

    The topic `/gps/fix` is `sequence."gps/fix"` and, if no other topic has that name, `sequence.gps_fix`.

    Raises:
        IngestError: DuckDB is not installed.
    """
    connection = _duckdb().connect(":memory:", config={"autoinstall_known_extensions": False})
    for info in sequences:
        connection.execute(f"CREATE SCHEMA IF NOT EXISTS {_quoted(info.name)}")
        for topic in info.topics:
            source = _source(connection, topic)
            for name in table_names(info, topic):
                view = f"{_quoted(info.name)}.{_quoted(name)}"
                connection.execute(f"CREATE OR REPLACE VIEW {view} AS FROM {source}")
    return connection


def table_names(info: SequenceInfo, topic: TopicInfo) -> list[str]:
    """Return the names of a topic's view: the topic without its first slash, and an identifier if it is unique."""
    name = topic.name.removeprefix("/")
    short = _short(name)
    others = [_short(other.name.removeprefix("/")).lower() for other in info.topics]
    return list(dict.fromkeys([name, *([short] if others.count(short.lower()) == 1 else [])]))


def read_only(query: str) -> None:
    """Check that a text is one statement that only reads.

    Raises:
        ViewError: It is not.
        IngestError: DuckDB is not installed.
    """
    duckdb = _duckdb()
    try:
        statements: Sequence[Any] = duckdb.extract_statements(query)
    except duckdb.Error as error:
        raise _explained(error) from error
    kinds = [str(statement.type).rpartition(".")[2] for statement in statements]
    if len(kinds) != 1:
        raise ViewError(f"the query has {len(kinds)} statements", hint="run one statement at a time")
    if kinds[0] not in _READ_ONLY:
        raise ViewError(
            f"{kinds[0]} statements are refused, because queries only read",
            hint="use SELECT; --out writes the result to a file",
        )


def _named_sequences(store: Store, query: str) -> Iterator[SequenceInfo]:
    """Yield the sequences that a query may use: all of a small store, else those whose names it contains."""
    names = store.names()
    text = query.lower()
    for name in names:
        if len(names) <= MAX_SEQUENCES or name.lower() in text:
            yield store.sequence(name)


def _source(connection: DuckDBPyConnection, topic: TopicInfo) -> str:
    """Return the source of a view: the topic's files, or its columns without rows."""
    paths = [segment.path for segment in topic.segments]
    if paths and not any(isinstance(path, RemotePath) for path in paths):
        return f"read_parquet([{', '.join(_text(str(path)) for path in paths)}])"
    name = f"{topic.sequence}{topic.name}"
    if paths:
        remote = [path for path in paths if isinstance(path, RemotePath)]
        files = [path.filesystem_path for path in remote]
        dataset: Any = ds.dataset(
            files, schema=topic.schema, format="parquet", filesystem=remote[0].filesystem
        )
        connection.register(name, dataset)
    else:
        connection.register(name, topic.schema.empty_table())
    return _quoted(name)


def _short(name: str) -> str:
    short = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return short if _IDENTIFIER.fullmatch(short) else f"_{short}"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _text(value: str) -> str:
    return "'" + value.replace("'", "''") + "'"


def _explained(error: Exception) -> ViewError:
    """Return the error with the first line of DuckDB's message, and its suggestion as the hint."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    hint = next((line for line in lines[1:] if line.startswith(("Did you mean", "Candidate"))), None)
    return ViewError(lines[0] if lines else type(error).__name__, hint=hint)


def _duckdb() -> Any:  # noqa: ANN401 - a module
    try:
        import duckdb  # noqa: PLC0415 - an optional library
    except ImportError as error:
        raise missing_library("DuckDB", "sql") from error
    return duckdb
