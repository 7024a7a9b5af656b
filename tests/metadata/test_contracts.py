"""Metadata of recordings and metadata contracts in lint, plans, runs and shipments."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from metadata_files import write
from msgspec.structs import replace
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mosaico_ingest import api
from mosaico_ingest.errors import ContractError, IngestError, ManifestError
from mosaico_ingest.findings import Finding
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.plan import Plan
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.report.events import RunFinished
from mosaico_ingest.services.status import Status

SCHEMA = {
    "type": "object",
    "required": ["vehicle"],
    "properties": {"vehicle": {"type": "string", "pattern": "^r[0-9]+$"}, "run": {"type": "integer"}},
    "additionalProperties": False,
}
Place = tuple[str, str, int, int]


def manifest(folder: Path, text: str, schema: Any = SCHEMA, *, recording: str = "r1_7.mcap") -> Path:
    """Write a schema and a manifest that continues after `sequence:`."""
    (folder / "vehicle.schema.json").write_text(json.dumps(schema))
    job = folder / "job.yaml"
    job.write_text(f"bag: {{path: {recording}}}\ntarget: {{store: store}}\nsequence:\n{text}")
    return job


def places(findings: tuple[Finding, ...]) -> list[Place]:
    return [(f.rule, Path(f.span.file).name, f.span.line, f.span.column) for f in findings if f.span]


def lint(job: Path) -> list[Place]:
    return places(lint_paths([job], env={}).findings)


def plan_of(job: Path) -> Plan:
    return make_plan(Task(api.compile_job(job)[0]))


def plan_error(job: Path) -> tuple[int, list[Place]]:
    with pytest.raises(IngestError) as error:
        plan_of(job)
    return error.value.exit_code, places(error.value.findings)


def run_error(job: Path) -> tuple[int, list[Place]]:
    ends: list[RunFinished] = []
    report = api.run(
        api.compile_job(job),
        observe=lambda _, event: ends.append(event) if isinstance(event, RunFinished) else None,
    )
    assert not (job.parent / "store" / "segments").exists()
    return report.exit_code, places(ends[0].findings)


@pytest.mark.parametrize(
    ("text", "line", "column"),
    [
        ("  metadata: {vehicle: x9}\n  metadata_schema: vehicle.schema.json\n", 4, 23),
        ("  metadata: {vehicel: r1}\n  metadata_schema: vehicle.schema.json\n", 4, 14),
        ("  metadata: {run: 1}\n  metadata_schema: vehicle.schema.json\n", 4, 3),
        ("  metadata_schema: vehicle.schema.json\n", 3, 1),
        ('  metadata: {vehicle: "${VEHICLE}"}\n  metadata_schema: vehicle.schema.json\ndefaults: {VEHICLE: x}\n', 4, 23),
        ('  metadata: {vehicle: "${v}"}\n  metadata_schema: vehicle.schema.json\nmatrix: {v: [r1, x]}\n', 4, 23),
    ],
)  # fmt: skip
def test_metadata_violation_has_same_rule_and_location_in_lint_plan_and_run(
    tmp_path: Path, text: str, line: int, column: int
) -> None:
    write(tmp_path / "r1_7.mcap")
    expected = [("metadata-schema", "job.yaml", line, column)]
    if "matrix" in text:
        text = text.replace("  metadata:", '  name: "a${v}"\n  metadata:')
        expected = [("metadata-schema", "job.yaml", line + 1, column)]
        job = manifest(tmp_path, text)
        assert lint(job) == expected
        with pytest.raises(ContractError) as error:
            make_plan(Task(api.compile_job(job)[1]))
        assert places(error.value.findings) == expected
        return
    job = manifest(tmp_path, text)
    assert lint(job) == expected
    assert plan_error(job) == (6, expected)
    assert run_error(job) == (6, expected)


def test_metadata_violation_in_extended_file_and_metadata_file_has_their_location(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    (tmp_path / "base.yaml").write_text("sequence:\n  metadata:\n    vehicle: x\n")
    (tmp_path / "more.json").write_text('{\n  "run": "seven"\n}')
    job = manifest(
        tmp_path, "  metadata_file: more.json\n  metadata_schema: vehicle.schema.json\nextends: base.yaml\n"
    )
    expected = [("metadata-schema", "base.yaml", 3, 14), ("metadata-schema", "more.json", 2, 10)]
    assert lint(job) == expected
    assert plan_error(job) == (6, expected)


def test_topic_metadata_violation_has_same_rule_and_location_in_lint_and_plan(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    job = manifest(
        tmp_path,
        '  name: x\ntopic_settings:\n  "/c*": {metadata_schema: vehicle.schema.json}\n  /count: {metadata: {vehicle: 3}}\n',
    )
    expected = [("metadata-schema", "job.yaml", 7, 32)]
    assert lint(job) == expected
    assert plan_error(job) == (6, expected)


def test_topic_glob_without_metadata_is_checked_by_plan_only(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    job = manifest(tmp_path, '  name: x\ntopic_settings:\n  "/c*": {metadata_schema: vehicle.schema.json}\n')
    assert lint(job) == []
    assert plan_error(job) == (6, [("metadata-schema", "job.yaml", 6, 3)])


def test_lint_unset_variable_is_not_a_violation(tmp_path: Path) -> None:
    job = manifest(tmp_path, '  metadata: {vehicle: "${V}"}\n  metadata_schema: vehicle.schema.json\n')
    assert places(lint_paths([job], env=None).findings) == []


def test_lint_invalid_and_missing_schema_have_own_rules(tmp_path: Path) -> None:
    job = manifest(tmp_path, "  metadata_schema: vehicle.schema.json\n", {"type": "strin"})
    assert lint(job) == [("invalid-schema", "vehicle.schema.json", 1, 10)]
    job = manifest(tmp_path, "  metadata_schema: none.json\n")
    assert lint(job) == [("missing-file", "job.yaml", 4, 20)]


def test_plan_invalid_schema_is_refused_with_its_location(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    job = manifest(tmp_path, "  metadata_schema: vehicle.schema.json\n", {"type": "strin"})
    assert plan_error(job) == (2, [("invalid-schema", "vehicle.schema.json", 1, 10)])


def test_metadata_from_fills_metadata_in_order_of_precedence(tmp_path: Path) -> None:
    records = {"drive": {"a": "record", "b": "record", "c": "record", "d": "record", "tyre.type": "x"}}
    write(tmp_path / "drive" / "file_name_d.mcap", records)
    (tmp_path / "drive" / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [file_name_d.mcap]\n"
        "  custom_data: {b: custom, c: custom, d: custom}\n"
    )
    (tmp_path / "drive.json").write_text('{"d": "sidecar", "e": "sidecar", "f": "sidecar"}')
    (tmp_path / "more.json").write_text('{"e": "file", "f": "file"}')
    job = manifest(
        tmp_path,
        "  metadata_from:\n    records: [dr*]\n    custom_data: true\n"
        '    file_name: "{c}"\n    sidecar: "{stem}.json"\n'
        "  metadata_file: more.json\n  metadata: {f: explicit}\n",
        recording="drive",
    )
    plan = plan_of(job)
    assert plan.sequence.metadata == {
        "a": "record", "b": "custom", "c": "drive", "d": "sidecar", "e": "file", "f": "explicit", "tyre_type": "x",
    }  # fmt: skip
    conflicts = [finding for finding in plan.findings if finding.rule == "metadata-conflict"]
    assert [finding.message.partition(" ")[0] for finding in conflicts] == ["b", "c", "d", "c", "d"]


@pytest.mark.parametrize("options", [{}, {"indexed": False}, {"truncated": True}])
def test_metadata_records_are_read_with_and_without_index(tmp_path: Path, options: dict[str, bool]) -> None:
    write(tmp_path / "r1_7.mcap", {"vehicle": {"vehicle": "r1"}, "other": {"x": "y"}}, **options)
    job = manifest(tmp_path, "  metadata_from: {records: [vehicle]}\n")
    assert plan_of(job).sequence.metadata == {"vehicle": "r1"}


def test_metadata_record_with_schema_has_required_types(tmp_path: Path) -> None:
    entries = {
        "run": "7",
        "dry": "true",
        "mass": "1.5",
        "vehicle": "12",
        "either": "8",
        "note": "x",
        "open": "3",
    }
    write(tmp_path / "r1_7.mcap", {"drive": entries})
    types: dict[str, Any] = {
        "run": {"$ref": "#/$defs/run"},
        "dry": {"type": "boolean"},
        "mass": {"type": ["number", "null"]},
        "vehicle": {"type": "string"},
        "either": {"type": ["integer", "string"]},
        "note": {},
    }
    schema = {"type": "object", "properties": types, "$defs": {"run": {"type": "integer"}}}
    text = "  metadata_from: {records: [drive]}\n  metadata_schema: vehicle.schema.json\n"
    job = manifest(tmp_path, text, schema)
    assert plan_of(job).sequence.metadata == {
        "run": 7, "dry": True, "mass": 1.5, "vehicle": "12", "either": "8", "note": "x", "open": "3",
    }  # fmt: skip
    manifest(tmp_path, text, {**schema, "properties": {**types, "note": {"type": "integer"}}})
    assert plan_error(job) == (6, [("metadata-schema", "job.yaml", 4, 29)])


def test_metadata_variable_with_kind_fulfills_schema(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "r1_7.mcap")
    monkeypatch.setenv("RUN", "7")
    text = "  metadata: {{vehicle: r1, run: '{}'}}\n  metadata_schema: vehicle.schema.json\n"
    job = manifest(tmp_path, text.format("${RUN:int}"))
    assert places(lint_paths([job], env={"RUN": "7"}).findings) == []
    assert plan_of(job).sequence.metadata == {"vehicle": "r1", "run": 7}
    assert plan_error(manifest(tmp_path, text.format("${RUN}"))) == (
        6,
        [("metadata-schema", "job.yaml", 4, 32)],
    )


def test_custom_data_is_read_from_record_of_rosbag2(tmp_path: Path) -> None:
    text = "version: 5\nmessage_count: 2\ncustom_data: {vehicle: r1}\n"
    write(tmp_path / "r1_7.mcap", {"rosbag2": {"serialized_metadata": text}})
    job = manifest(tmp_path, "  metadata_from: {custom_data: true}\n")
    assert plan_of(job).sequence.metadata == {"vehicle": "r1"}


def test_custom_data_is_read_from_table_of_db3_file(tmp_path: Path) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        types = get_typestore(Stores.ROS2_HUMBLE)
        connection = writer.add_connection("/a", "std_msgs/msg/Int8", typestore=types)
        message = types.types["std_msgs/msg/Int8"](data=1)
        writer.write(connection, 1, types.serialize_cdr(message, "std_msgs/msg/Int8"))
    (file,) = (tmp_path / "bag").glob("*.db3")
    file.rename(tmp_path / "r1_7.db3")
    texts = ["custom_data: {vehicle: old}", "custom_data: {vehicle: r1}"]
    with closing(sqlite3.connect(tmp_path / "r1_7.db3")) as database:
        database.execute("DROP TABLE IF EXISTS metadata")
        database.execute(
            "CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL)"
        )
        rows = [(5, f"version: 5\nmessage_count: 1\n{text}\n") for text in texts]
        database.executemany("INSERT INTO metadata(metadata_version, metadata) VALUES (?, ?)", rows)
        database.commit()
    job = manifest(tmp_path, "  metadata_from: {custom_data: true}\n", recording="r1_7.db3")
    assert plan_of(job).sequence.metadata == {"vehicle": "r1"}


def test_metadata_from_without_match_is_a_finding_per_source(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    job = manifest(
        tmp_path,
        '  metadata_from:\n    records: [a]\n    custom_data: true\n    file_name: "{a}.bag"\n    sidecar: "{name}.json"\n',
    )
    plan = plan_of(job)
    assert places(plan.findings) == [
        ("metadata-source", "job.yaml", 5, 15),
        ("metadata-source", "job.yaml", 6, 18),
        ("metadata-source", "job.yaml", 7, 16),
        ("metadata-source", "job.yaml", 8, 14),
    ]
    assert plan.sequence.metadata == {}


@pytest.mark.parametrize("text", ["{", "[1]"])
def test_invalid_sidecar_is_refused_with_location(tmp_path: Path, text: str) -> None:
    write(tmp_path / "r1_7.mcap", sidecar=text)
    job = manifest(tmp_path, '  metadata_from: {sidecar: "{stem}.json"}\n')
    code, actual = plan_error(job)
    assert code == 2
    assert [place[:3] for place in actual] == [("invalid-sidecar", "r1_7.json", 1)]


def test_violation_of_source_has_location_of_source(tmp_path: Path) -> None:
    write(tmp_path / "x1_7.mcap", sidecar='{\n  "run": "x"\n}')
    job = manifest(
        tmp_path,
        '  metadata_from: {file_name: "{vehicle}_{_}.mcap", sidecar: "{stem}.json"}\n'
        "  metadata_schema: vehicle.schema.json\n",
        recording="x1_7.mcap",
    )
    assert lint(job) == []
    expected = [("metadata-schema", "job.yaml", 4, 30), ("metadata-schema", "x1_7.json", 2, 10)]
    assert plan_error(job) == (6, expected)


def test_lint_with_pattern_reports_missing_key_that_no_source_fills(tmp_path: Path) -> None:
    job = manifest(
        tmp_path, '  metadata_from: {file_name: "{run:int}.mcap"}\n  metadata_schema: vehicle.schema.json\n'
    )
    assert lint(job) == [("metadata-schema", "job.yaml", 3, 1)]


def test_lint_invalid_pattern_and_placeholder_are_wrong_values(tmp_path: Path) -> None:
    job = manifest(tmp_path, '  metadata_from: {file_name: "{a:itn}", sidecar: "{stm}.json"}\n')
    assert lint(job) == [("wrong-value", "job.yaml", 4, 30), ("wrong-value", "job.yaml", 4, 50)]


def test_batch_recordings_have_their_own_metadata(tmp_path: Path) -> None:
    for vehicle, run in (("r1", 1), ("r2", 2)):
        write(tmp_path / f"{vehicle}_{run}.mcap", sidecar={"vehicle": vehicle})
    job = manifest(
        tmp_path,
        '  metadata_from: {file_name: "{_}_{run:int}.mcap", sidecar: "{stem}.json"}\n'
        "  metadata_schema: vehicle.schema.json\n",
        recording='"*.mcap"',
    )
    report = api.run(api.compile_job(job))
    assert report.exit_code == 0
    plans = [make_plan(Task(one)) for one in api.compile_job(job)]
    assert [plan.sequence.metadata for plan in plans] == [
        {"vehicle": "r1", "run": 1},
        {"vehicle": "r2", "run": 2},
    ]


def test_status_after_changed_sidecar_is_changed(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap", sidecar={"vehicle": "r1"})
    job = manifest(tmp_path, '  metadata_from: {sidecar: "{stem}.json"}\n')
    assert api.run(api.compile_job(job)).exit_code == 0
    assert [one.status for one in api.job_status(job)] == [Status.DONE]
    (tmp_path / "r1_7.json").write_text('{"vehicle": "r2"}')
    assert [one.status for one in api.job_status(job)] == [Status.CHANGED]


def test_status_after_changed_schema_is_done(tmp_path: Path) -> None:
    write(tmp_path / "r1_7.mcap")
    job = manifest(tmp_path, "  metadata: {vehicle: r1}\n  metadata_schema: vehicle.schema.json\n")
    assert api.run(api.compile_job(job)).exit_code == 0
    manifest(tmp_path, "  metadata: {vehicle: r1}\n  metadata_schema: vehicle.schema.json\n", {})
    assert [one.status for one in api.job_status(job)] == [Status.DONE]


def test_pack_copies_schema_with_its_references(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="Ray is not installed")
    from mosaico_ingest.executors.ray import absolute, pack  # noqa: PLC0415 - it imports Ray

    write(tmp_path / "in" / "r1_7.mcap")
    (tmp_path / "in" / "word.json").write_text('{"type": "string"}')
    schema = {"properties": {"vehicle": {"$ref": "word.json"}}}
    job = manifest(
        tmp_path / "in",
        "  metadata: {vehicle: 3}\n  metadata_schema: vehicle.schema.json\n"
        'topic_settings: {"/c*": {metadata_schema: vehicle.schema.json}}\n',
        schema,
    )
    [task] = pack([absolute(Task(api.compile_job(job)[0]))], tmp_path / "box")
    (tmp_path / "in" / "word.json").unlink()
    (tmp_path / "in" / "vehicle.schema.json").unlink()
    moved = task.job.replace(
        sequence=task.job.sequence.replace(
            metadata_schema=str(tmp_path / "box" / str(task.job.sequence.metadata_schema))
        ),
        topic_settings={},
    )
    assert not Path(str(task.job.topic_settings["/c*"].metadata_schema)).is_absolute()
    with pytest.raises(ContractError) as error:
        make_plan(replace(task, job=moved, code_dir=None))
    assert places(error.value.findings) == [("metadata-schema", "job.yaml", 4, 23)]


def test_configuration_accepts_metadata_schema_and_sources(tmp_path: Path) -> None:
    recording = write(tmp_path / "x_7.mcap")
    (tmp_path / "vehicle.schema.json").write_text(json.dumps(SCHEMA))
    config = ROSInjectionConfig(
        file_path=recording,
        sequence_name="s",
        manifest={
            "sequence": {
                "metadata_from": {"file_name": "{vehicle}_{run:int}.mcap"},
                "metadata_schema": tmp_path / "vehicle.schema.json",
            }
        },
    )
    with pytest.raises(ContractError) as error:
        api.RosbagInjector(config).plan()
    assert [finding.rule for finding in error.value.findings] == ["metadata-schema"]


def test_configuration_with_invalid_pattern_names_the_argument(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="metadata_from"):
        ROSInjectionConfig(tmp_path, "s", manifest={"sequence": {"metadata_from": {"file_name": "{a:itn}"}}})
