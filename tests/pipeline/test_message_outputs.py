"""Runs whose adapters drop messages, or convert one message to several rows or topics: the accounting is exact."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from made_recordings import define, record
from mcap.writer import Writer as OfficialWriter

from mosaico_ingest import api
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.destinations.store.store import verify
from mosaico_ingest.errors import ManifestError, NothingMatched
from mosaico_ingest.export import export_sequence
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.run import Outcome, make_plan, run_recording
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.pipeline.topic import TopicPipeline
from mosaico_ingest.report.recording import TopicReport
from mosaico_ingest.rosbag.blocks import Encoding
from mosaico_ingest.rosbag.serialization import Serializer

BATCH = define(
    "acme_msgs/msg/Batch",
    "string name\nacme_msgs/Item[] items\n"
    "================================================================================\n"
    "MSG: acme_msgs/Item\nint32 id\nfloat64 mass\n",
)
START_NS = 1_700_000_000 * 10**9
ITEMS = """version: 1
adapter: ItemsAdapter
ros_type: acme_msgs/msg/Batch
parameters: {heavy: 100}
drop_when: name == 'test'
"""
ROWS_FILE = (
    ITEMS
    + """rows: items[]
let: {batch: name}
ontology: {tag: Item, fields: {batch: string, id: int8, mass: float64}}
fields: {batch: batch, id: cast(id), mass: mass}
"""
)
OUTPUTS_FILE = (
    ITEMS
    + """outputs:
  items:
    rows: items[]
    ontology: {tag: Item, fields: {id: int8}}
    fields: {id: cast(id)}
  heavy:
    drop_when: not any(items[].mass > heavy)
    ontology: {tag: Heavy, fields: {name: string, total: float64}}
    fields: {name: name, total: "sum(items[].mass)"}
"""
)
MESSAGES: list[tuple[str, list[tuple[int, float]]]] = [
    ("a", [(1, 1.0), (2, 200.0)]),
    ("test", [(3, 1.0)]),
    ("b", []),
    ("c", [(4, 2.0)]),
    ("bad", [(5, 1.0), (1000, 300.0)]),
    ("d", [(6, 1.0), (7, 1.0), (8, 150.0)]),
]


def recording(folder: Path, messages: list[tuple[str, list[tuple[int, float]]]] = MESSAGES) -> Path:
    return record(
        folder / "batches.mcap",
        (
            (
                "/batch",
                BATCH,
                START_NS + at,
                {"name": name, "items": [{"id": i, "mass": m} for i, m in items]},
            )
            for at, (name, items) in enumerate(messages)
        ),
    )


def job(folder: Path, adapter: str, **keys: Any) -> Task:
    (folder / "items.yaml").write_text(adapter)
    manifest = {
        "version": 1,
        "bag": {"path": "batches.mcap"},
        "sequence": {"name": "s"},
        "target": {"store": "store"},
        "adapters": {"load": ["items.yaml"]},
        "on_error": {"topic": "ignore"},
        **keys,
    }
    (folder / "job.yaml").write_text(json.dumps(manifest))
    return Task(api.compile_job(folder / "job.yaml")[0])


def run(folder: Path, adapter: str, **keys: Any) -> Outcome:
    return run_recording(job(folder, adapter, **keys))


def stored(folder: Path, topic: str) -> list[dict[str, Any]]:
    with Store.open(folder / "store").scan("s", topic) as reader:
        return [row for batch in reader for row in batch.to_pylist()]


def numbers(topic: TopicReport) -> tuple[int, int, int, int, int]:
    assert topic.promised == topic.read + topic.unreadable
    assert topic.read == topic.written + topic.filtered + topic.downsampled + topic.rejected
    return topic.read, topic.written, topic.rows, topic.filtered, topic.rejected


def test_rows_of_messages_are_counted_apart_from_messages(tmp_path: Path) -> None:
    recording(tmp_path)
    report = run(tmp_path, ROWS_FILE).report
    [topic] = report.topics
    assert numbers(topic) == (6, 3, 6, 2, 1)
    assert topic.dropped == {"drop_when": 1, "rows": 1}
    assert (report.exit_code, report.totals.rows) == (4, 6)
    rows = stored(tmp_path, "/batch")
    assert [(row["timestamp_ns"] - START_NS, row["batch"], row["id"]) for row in rows] == [
        (0, "a", 1), (0, "a", 2), (3, "c", 4), (5, "d", 6), (5, "d", 7), (5, "d", 8),
    ]  # fmt: skip


def test_outputs_count_each_message_once_and_write_it_to_each_topic(tmp_path: Path) -> None:
    recording(tmp_path)
    task = job(tmp_path, OUTPUTS_FILE, quarantine={"path": "quarantine"})
    plan = make_plan(task)
    assert [(topic.target, topic.ontology.tag, topic.shares_messages) for topic in plan.topics] == [
        ("/batch/items", "Item", False),
        ("/batch/heavy", "Heavy", True),
    ]
    report = run_recording(task).report
    items, heavy = report.topics
    assert numbers(items) == (6, 3, 6, 2, 1)
    assert numbers(heavy) == (6, 3, 2, 2, 1)
    totals = report.totals
    assert (totals.promised, totals.read, totals.written, totals.rows) == (6, 6, 3, 8)
    assert (totals.filtered, totals.rejected) == (2, 1)
    assert [row["id"] for row in stored(tmp_path, "/batch/items")] == [1, 2, 4, 6, 7, 8]
    assert [row["total"] for row in stored(tmp_path, "/batch/heavy")] == [201.0, 152.0]
    [index] = (tmp_path / "quarantine").glob("*.jsonl")
    assert len(index.read_text().splitlines()) == 1
    assert [one.problem for one in verify(Store.open(tmp_path / "store").sequence("s"))] == [None, None]


def test_repeated_run_with_outputs_is_skipped(tmp_path: Path) -> None:
    recording(tmp_path, [message for message in MESSAGES if message[0] != "bad"])
    task = job(tmp_path, OUTPUTS_FILE, sequence={"name": "s", "if_exists": "skip"})
    statuses = [run_recording(task).report.status.value for _ in range(2)]
    assert statuses == ["completed", "skipped"]


@pytest.mark.parametrize("adapter", [ROWS_FILE, OUTPUTS_FILE])
def test_accounting_is_independent_of_the_size_of_blocks(
    tmp_path: Path, adapter: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording(tmp_path, MESSAGES * 5)
    whole = run(tmp_path, adapter).report
    rows = {topic.target: stored(tmp_path, topic.target) for topic in whole.topics}
    process = TopicPipeline.process

    def in_parts(self: TopicPipeline, block: Any, buffer: Any, *, latched: bool = False) -> None:
        for start in range(0, len(block), 4):
            process(self, block.rows(slice(start, start + 4)), buffer, latched=latched)

    monkeypatch.setattr(TopicPipeline, "process", in_parts)
    parts = run(tmp_path, adapter, sequence={"name": "s", "if_exists": "replace"}).report
    assert list(map(numbers, parts.topics)) == list(map(numbers, whole.topics))
    assert {topic.target: stored(tmp_path, topic.target) for topic in parts.topics} == rows


@pytest.mark.parametrize("adapter", [ROWS_FILE, OUTPUTS_FILE])
def test_finalized_topic_accounts_for_all_messages(tmp_path: Path, adapter: str) -> None:
    recording(tmp_path)
    report = run(tmp_path, adapter, on_error={"topic": "finalize"}).report
    for topic in report.topics:
        assert numbers(topic)[0] == 6
        assert (topic.written, topic.rejected) == (2, 2)


def test_dropping_all_messages_writes_nothing(tmp_path: Path) -> None:
    recording(tmp_path, [("test", [(1, 1.0)])] * 3)
    outcome = run(tmp_path, ROWS_FILE)
    assert isinstance(outcome.error, NothingMatched)


def test_contract_counts_rejected_messages_and_not_rows(tmp_path: Path) -> None:
    recording(tmp_path)
    expect = {
        "topics": {"/batch": {"rejected": {"max": 1}, "messages": {"min": 6, "max": 6}}},
        "on_failure": "warn",
    }
    for adapter in (ROWS_FILE, OUTPUTS_FILE):
        contract = run(
            tmp_path, adapter, expect=expect, sequence={"name": "s", "if_exists": "replace"}
        ).report.contract
        assert contract is not None
        assert contract.passed, contract


@pytest.mark.parametrize(
    ("adapter", "topic", "key"),
    [
        (ROWS_FILE, "/batch", "rows:"),
        (OUTPUTS_FILE, "/batch/items", "    rows:"),
        (OUTPUTS_FILE, "/batch/heavy", "outputs:"),
    ],
)
def test_export_of_several_rows_or_topics_is_refused_at_their_key(
    tmp_path: Path, adapter: str, topic: str, key: str
) -> None:
    recording(tmp_path)
    run(tmp_path, adapter)
    file = tmp_path / "items.yaml"
    report = export_sequence(
        Store.open(tmp_path / "store"), "s", tmp_path / "out.mcap", adapters=[str(file)], dry_run=True
    )
    excluded = {one.topic: one for one in report.topics}[topic]
    line = next(at for at, text in enumerate(adapter.splitlines(), 1) if text.startswith(key))
    column = len(key) - len(key.lstrip()) + 1
    assert (excluded.rule, excluded.location) == ("no-inverse", f"{file}:{line}:{column}")
    assert excluded.exclusion.startswith(f"{file}:{line}:{column}: warning[no-inverse] ")


def test_message_properties_equal_recording(tmp_path: Path) -> None:
    with (tmp_path / "batches.mcap").open("wb") as file:
        writer = OfficialWriter(file)
        writer.start("ros2", "test")
        schema = writer.register_schema("acme_msgs/msg/Batch", "ros2msg", BATCH.text.encode())
        channel = writer.register_channel("/batch", "cdr", schema)
        payload = Serializer(BATCH, Encoding.CDR).from_dict({"name": "a", "items": []})
        for at in range(5):
            writer.add_message(channel, START_NS + at, payload, START_NS - 10 * at, sequence=7 * at)
        writer.finish()
    adapter = (
        ITEMS.replace("drop_when: name == 'test'", "drop_when: message.sequence == 14")
        + """
ontology: {tag: Times, fields: {log: int64, publish: int64, topic: string, number: int64}}
fields: {log: message.log_time, publish: message.publish_time, topic: message.topic, number: message.sequence}
"""
    )
    [topic] = run(tmp_path, adapter).report.topics
    assert numbers(topic) == (5, 4, 4, 1, 0)
    rows = stored(tmp_path, "/batch")
    kept = np.array([0, 1, 3, 4])
    assert [row["log"] for row in rows] == (START_NS + kept).tolist()
    assert [row["publish"] for row in rows] == (START_NS - 10 * kept).tolist()
    assert [row["number"] for row in rows] == (7 * kept).tolist()
    assert {row["topic"] for row in rows} == {"/batch"}
    assert pa.types.is_string(
        Store.open(tmp_path / "store").sequence("s").topics[0].ontology.struct.field("topic").type
    )


@pytest.mark.parametrize("is_override", [False, True])
def test_parameters_of_the_manifest_replace_the_defaults(tmp_path: Path, *, is_override: bool) -> None:
    recording(tmp_path)
    adapter = {"file": "items.yaml", "with": {"heavy": 160}}
    adapters = {"override": {"/batch": adapter}} if is_override else {"load": [adapter]}
    items, heavy = run(tmp_path, OUTPUTS_FILE, adapters=adapters).report.topics
    assert (numbers(items), numbers(heavy)) == ((6, 3, 6, 2, 1), (6, 3, 1, 2, 1))
    assert [row["total"] for row in stored(tmp_path, "/batch/heavy")] == [201.0]


@pytest.mark.parametrize("values", [{"hevy": 160}, {"heavy": "160"}])
@pytest.mark.parametrize("entry", ["load:\n    - file:", "override:\n    /batch:\n      file:"])
def test_wrong_parameter_has_one_rule_and_location_in_lint_and_run(
    tmp_path: Path, values: dict[str, object], entry: str
) -> None:
    recording(tmp_path)
    [(name, value)] = values.items()
    (tmp_path / "items.yaml").write_text(OUTPUTS_FILE)
    (tmp_path / "job.yaml").write_text(
        "version: 1\nbag: {path: batches.mcap}\nsequence: {name: s}\ntarget: {store: store}\n"
        f"adapters:\n  {entry} items.yaml\n      with:\n        {name}: {json.dumps(value)}\n"
    )
    [linted] = lint_paths([tmp_path / "job.yaml"], env={}).findings
    with pytest.raises(ManifestError) as caught:
        api.compile_job(tmp_path / "job.yaml")
    [compiled] = caught.value.findings
    for finding in (linted, compiled):
        assert finding.rule == "adapter-parameter"
        assert finding.span is not None
        assert finding.span.line == 9 + entry.startswith("override")
    assert linted.span == compiled.span


def expected_of_outputs(folder: Path) -> dict[str, Any]:
    topics = {
        "/batch": {"messages": {"min": 6}, "fields": {"name": {"one_of": ["a"]}}},
        "/batch/items": {
            "type": "acme_msgs/msg/Batch",
            "messages": {"max": 9},
            "gap": {"max": "1 ns"},
            "fields": {"id": {"max": 6}},
        },
        "/batch/heavy": {"fields": {"total": {"between": [150, 202]}}},
    }
    expect = {"on_failure": "warn", "required": ["/batch/heavy"], "topics": topics}
    (folder / "expect.yaml").write_text(json.dumps({"expect": expect}))
    return expect


def measured_of(contract: Any) -> dict[tuple[str | None, str], tuple[str, Any, Any]]:
    return {
        (one.topic, one.key): (one.outcome.value, one.measured, one.worst and one.worst.index)
        for one in contract.results
    }


def test_contract_checks_the_columns_of_each_output(tmp_path: Path) -> None:
    recording(tmp_path)
    report = run(tmp_path, OUTPUTS_FILE, expect=expected_of_outputs(tmp_path)).report
    results = measured_of(report.contract)
    assert {key: value for key, value in results.items() if key[0] != "/batch"} == {
        (None, "required.0"): ("passed", 1, None),
        ("/batch/items", "type"): ("passed", "acme_msgs/msg/Batch", None),
        ("/batch/items", "messages"): ("passed", 6, None),
        ("/batch/items", "gap"): ("failed", 3, 2),
        ("/batch/items", "fields.id.max"): ("failed", 8, 5),
        ("/batch/heavy", "fields.total.between"): ("passed", 152.0, None),
    }
    assert results["/batch", "messages"][:2] == ("passed", 6)
    checked = api.check_sequence(str(tmp_path / "store"), "s", tmp_path / "expect.yaml")
    in_store = measured_of(checked.contract)
    assert {key: in_store[key] for key in results if key[0] != "/batch"} == {
        key: value for key, value in results.items() if key[0] != "/batch"
    }
    (again,) = api.check(tmp_path / "job.yaml")
    assert measured_of(again.contract) == results
    (planned,) = api.plan_job(tmp_path / "job.yaml").recordings
    assert planned.contract is not None
    of_outputs = {
        (one.topic, one.key) for one in planned.contract.results if one.topic not in {None, "/batch"}
    }
    assert of_outputs == {("/batch/items", "fields.id.max")}  # the sample reveals it


def test_contract_unknown_column_of_output_is_a_located_error(tmp_path: Path) -> None:
    recording(tmp_path)
    topics = {"/batch/heavy": {"fields": {"totl": {"max": 1}}}}
    with pytest.raises(ManifestError) as error:
        make_plan(job(tmp_path, OUTPUTS_FILE, expect={"topics": topics}))
    (finding,) = error.value.findings
    assert finding.rule == "unknown-field"
    assert "total" in (finding.help or "")


def test_lint_checks_columns_of_outputs_of_known_types(tmp_path: Path) -> None:
    adapter = (
        "version: 1\nadapter: Split\nros_type: std_msgs/msg/Int32\ndefault: false\noutputs:\n"
        "  low: {ontology: {tag: Low, fields: {bits: int32}}, fields: {bits: data & 255}}\n"
        "  high: {ontology: {tag: High, fields: {rest: int32}}, fields: {rest: data >> 8}}\n"
    )
    (tmp_path / "split.yaml").write_text(adapter)
    (tmp_path / "job.yaml").write_text(
        "bag: {path: a.mcap}\nadapters: {override: {/n: split.yaml}}\nexpect:\n  topics:\n"
        '    "/n*": {type: std_msgs/msg/Int32}\n    /n: {fields: {data: {max: 9}, bits: {max: 9}}}\n'
        "    /n/low: {fields: {bits: {max: 9}}}\n    /n/high: {fields: {bits: {max: 9}}}\n"
    )
    findings = lint_paths([tmp_path / "job.yaml"], env={}).findings
    unknown = [
        one.span and (one.span.line, one.span.column) for one in findings if one.rule == "unknown-field"
    ]
    assert unknown == [(6, 35), (8, 24)]
