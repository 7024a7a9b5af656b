"""`ingest store sql`: a view per topic, read-only statements, and results as table, CSV, JSON and Parquet."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from mosaico_ingest import api
from mosaico_ingest.cli.app import command_line
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.view import sql as view_sql
from mosaico_ingest.view.sql import run_query

JOB = Path(__file__).resolve().parents[2] / "configs" / "quickstart.yaml"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("sql") / "store"
    (job,) = api.compile_job(JOB)  # its store is in the checkout
    other = job.replace(sequence=job.sequence.replace(name="other-drive"))
    api.run([one.replace(target=one.target.replace(store=str(folder))) for one in (job, other)])
    return str(folder)


@pytest.fixture
def output(store: str) -> Callable[..., str]:
    """Return the function that runs `ingest store sql` and returns its output, or the text of its error."""

    def run(*words: str, code: int = 0) -> str:
        result = CliRunner().invoke(command_line(["store"]), ["store", "sql", *words, "--store", store])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            assert code == 1, result.exception
            return str(result.exception)
        assert result.exit_code == code, result.output
        return result.output

    return run


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("SELECT count(*) AS n FROM quickstart_drive.imu", [{"n": 1000}]),
        ('SELECT count(*) AS n FROM "other-drive".imu', [{"n": 1000}]),
        ('SELECT count(*) AS n FROM quickstart_drive."gps/fix"', [{"n": 50}]),
        ("SELECT count(*) AS n FROM quickstart_drive.gps_fix", [{"n": 50}]),
        ("SELECT max(acceleration.z) AS z FROM quickstart_drive.imu", [{"z": 9.81}]),
        ("FROM range(2)", [{"range": 0}, {"range": 1}]),
        (
            'SELECT count(*) AS n FROM quickstart_drive.imu JOIN "other-drive".odom USING (timestamp_ns)',
            [{"n": 0}],
        ),
    ],
)
def test_sql_reads_topics_by_name(output: Callable[..., str], query: str, expected: object) -> None:
    assert json.loads(output(query, "--json")) == expected


def test_sql_prints_table_and_states_limit(output: Callable[..., str]) -> None:
    text = output("SELECT timestamp_ns, acceleration.z AS z FROM quickstart_drive.imu ORDER BY 1", "-n", "2")
    assert text.splitlines() == [
        "       timestamp_ns     z",
        "1767225600000050000  9.81",
        "1767225600010050000  9.81",
        "the first 2 rows; --limit prints more, --out writes all",
    ]


def test_sql_csv_has_one_line_per_row(output: Callable[..., str]) -> None:
    rows = list(csv.DictReader(io.StringIO(output("FROM quickstart_drive.joint_states LIMIT 3", "--csv"))))
    assert [row["names"] for row in rows] == ['["left_wheel", "right_wheel"]'] * 3


def test_sql_writes_files(output: Callable[..., str], tmp_path: Path) -> None:
    query = "SELECT timestamp_ns, orientation FROM quickstart_drive.imu"
    output(query, "--out", str(tmp_path / "x.parquet"))
    table = pq.read_table(tmp_path / "x.parquet")
    assert (table.num_rows, table.schema.names) == (1000, ["timestamp_ns", "orientation"])
    output(query, "--out", str(tmp_path / "x.csv"))
    assert len(list(csv.reader((tmp_path / "x.csv").read_text().splitlines()))) == 1001
    output(query, "--out", str(tmp_path / "x.json"))
    assert len(json.loads((tmp_path / "x.json").read_text())) == 1000
    output(f"{query} LIMIT 0", "--out", str(tmp_path / "x.json"))
    assert json.loads((tmp_path / "x.json").read_text()) == []


@pytest.mark.parametrize(
    "query",
    [
        "COPY (SELECT 1) TO 'x.csv'",
        "CREATE TABLE a AS SELECT 1",
        "ATTACH 'x.db'",
        "SET threads = 1",
        "INSTALL httpfs",
        "SELECT 1; DROP VIEW quickstart_drive.imu",
        "",
        "SELEC 1",
        "SELECT nothing FROM quickstart_drive.imu",
        "SELECT * FROM quickstart_drive.nothing",
    ],
)
def test_sql_refuses_changes_and_explains_mistakes(
    output: Callable[..., str], query: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "\n" not in output(query, code=1)
    assert not list(tmp_path.iterdir())


def test_sql_without_query_lists_tables(output: Callable[..., str]) -> None:
    rows = {row["table"]: row["rows"] for row in json.loads(output("--json"))}
    assert rows["quickstart_drive.camera_image_raw_compressed"] == 50
    assert rows['"other-drive".imu'] == 1000
    assert '"other-drive".imu' in output()
    for table, count in rows.items():
        assert json.loads(output(f"FROM (DESCRIBE {table}) SELECT count(*) > 1 AS n", "--json")) == [
            {"n": True}
        ]
        assert count in {10, 50, 200, 500, 1000}


def test_sql_unknown_suffix_is_refused(output: Callable[..., str]) -> None:
    assert ".txt is no supported suffix" in output("SELECT 1", "--out", "x.txt", code=1)


def test_sql_without_duckdb_names_the_extra(
    output: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "duckdb", None)
    assert "mosaico-ingest[sql]" in output("SELECT 1", code=1)


def test_run_query_large_store_opens_only_named_sequences(
    store: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(view_sql, "MAX_SEQUENCES", 1)
    opened = Store.open(store, create=False)
    named = view_sql._named_sequences(opened, "SELECT * FROM Quickstart_Drive.imu")
    assert [info.name for info in named] == ["quickstart_drive"]
    assert run_query(opened, 'FROM "OTHER-drive".imu').read_all().num_rows == 1000
