"""Lock files: their content, and each kind of difference between them and recordings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator
from made_recordings import define, record

from mosaico_ingest import api
from mosaico_ingest.cli.app import main
from mosaico_ingest.documents import document_schema
from mosaico_ingest.errors import ContractError, IngestError, ManifestError
from mosaico_ingest.lint.engine import lint_paths
from mosaico_ingest.pipeline.definition_changes import (
    Change,
    LockDocument,
    LockedTopic,
    lock_differences,
)
from mosaico_ingest.pipeline.run import make_plan
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.services.schemas import write_lock

PACK = "uint8 FULL=1\nfloat32 voltage\nint32 cells\nacme_msgs/Cell first\n"
CELL = f"{'=' * 80}\nMSG: acme_msgs/Cell\nfloat32 level\n"
VALUES = {"voltage": 1.0, "cells": 2, "first": {"level": 0.5}}
MANIFEST = "bag: {path: run.mcap}\ntarget: {store: store}\ndefinitions: locked\n"


def make(
    path: Path, text: str = PACK + CELL, *, topic: str = "/pack", values: Any = None, **more: Any
) -> Path:
    """Write a recording with one message of a battery pack, and with one message for each further topic."""
    definition = define("acme_msgs/msg/Pack", text)
    messages = [(topic, definition, 1, VALUES if values is None else values)]
    number = define("std_msgs/msg/Int32", "int32 data\n")
    messages += [(f"/{name}", number, 2, {"data": value}) for name, value in more.items()]
    return record(path, messages)


def job(folder: Path, text: str = MANIFEST) -> Path:
    manifest = folder / "job.yaml"
    manifest.write_text(text)
    return manifest


def lock(manifest: Path) -> Path:
    write_lock(manifest, api.compile_job(manifest, locked=False))
    return manifest.with_suffix(".lock.json")


def run_main(*words: str) -> int:
    with pytest.raises(SystemExit) as leave:
        main(list(words))
    return int(leave.value.code or 0)


def changes(folder: Path, write: Callable[[Path], object]) -> list[tuple[str, int]]:
    """Return the messages and lines of the differences after the recording of a locked job was replaced."""
    recording = folder / "run.mcap"
    make(recording)
    manifest = job(folder)
    lock(manifest)
    recording.unlink()
    write(recording)
    with pytest.raises(ContractError) as error:
        make_plan(Task(api.compile_job(manifest)[0]))
    assert {finding.rule for finding in error.value.findings} == {"definition-difference"}
    return [(f.message, f.span.line) for f in error.value.findings if f.span]


def names(found: list[tuple[str, int]]) -> list[str]:
    """Return the differences without those of columns, which follow from them."""
    return [message for message, _ in found if "column" not in message]


def test_lock_of_unchanged_recording_passes_plan_run_and_check(tmp_path: Path) -> None:
    make(tmp_path / "run.mcap")
    manifest = job(tmp_path)
    lock(manifest)
    assert run_main("schema", "lock", "--check", str(manifest)) == 0
    assert run_main("plan", str(manifest)) == 0
    assert run_main("run", str(manifest), "-q") == 0


def test_lock_file_has_types_fields_and_columns_and_matches_its_schema(tmp_path: Path) -> None:
    make(tmp_path / "run.mcap", number=3)
    document = json.loads(lock(job(tmp_path)).read_text())
    Draft202012Validator(document_schema(LockDocument)).validate(document)
    assert list(document["topics"]) == ["/number", "/pack"]
    assert document["topics"]["/pack"]["columns"] == {
        "voltage": "float", "cells": "int32", "first.level": "float",
    }  # fmt: skip
    assert document["definitions"]["acme_msgs/msg/Pack"] == {
        "acme_msgs/msg/Cell": ["float32 level"],
        "acme_msgs/msg/Pack": ["uint8 FULL=1", "float32 voltage", "int32 cells", "acme_msgs/msg/Cell first"],
    }


def test_lock_of_same_recording_is_identical(tmp_path: Path) -> None:
    make(tmp_path / "run.mcap", number=3)
    path = lock(job(tmp_path))
    before = path.read_bytes()
    lock(job(tmp_path))
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("text", "values", "expected"),
    [
        (PACK.replace("uint8 FULL=1", "uint8 FULL=2"), VALUES,
         ["changed constant acme_msgs/msg/Pack.FULL: uint8 1 → uint8 2"]),
        (PACK.replace("uint8 FULL=1\n", ""), VALUES, ["missing constant acme_msgs/msg/Pack.FULL = uint8 1"]),
        (f"{PACK}uint8 LOW=2\n", VALUES, ["new constant acme_msgs/msg/Pack.LOW = uint8 2"]),
        (PACK.replace("float32 voltage", "float64 voltage"), VALUES,
         ["changed field acme_msgs/msg/Pack.voltage: float32 → float64"]),
        (PACK.replace("voltage", "volts"), {**VALUES, "volts": 1.0},
         ["renamed field acme_msgs/msg/Pack.voltage → volts"]),
        (PACK.replace("int32 cells\n", ""), VALUES, ["missing field acme_msgs/msg/Pack.cells: int32"]),
        (f"{PACK}string name\n", {**VALUES, "name": ""}, ["new field acme_msgs/msg/Pack.name: string"]),
        (PACK.replace("float32 voltage\nint32 cells\n", "int32 cells\nfloat32 voltage\n"), VALUES,
         ["moved field acme_msgs/msg/Pack.voltage: position 1 → 2", "moved field acme_msgs/msg/Pack.cells: position 2 → 1"]),
    ],
)  # fmt: skip
def test_changed_definition_is_a_named_difference(
    tmp_path: Path, text: str, values: Any, expected: list[str]
) -> None:
    used = {key: value for key, value in values.items() if f" {key}\n" in text}
    differences = changes(tmp_path, lambda path: make(path, text + CELL, values=used))
    assert names(differences) == [f"/pack: {message}" for message in expected]


def test_changed_nested_type_is_a_named_difference(tmp_path: Path) -> None:
    differences = changes(tmp_path, lambda path: make(path, PACK + CELL.replace("float32", "float64")))
    assert names(differences) == ["/pack: changed field acme_msgs/msg/Cell.level: float32 → float64"]
    assert [message for message, _ in differences if "column" in message] == [
        "/pack: changed column first.level: float → double"
    ]


def test_changed_topics_and_types_are_named_differences(tmp_path: Path) -> None:
    differences = changes(tmp_path, lambda path: make(path, number=1, topic="/other"))
    assert names(differences) == [
        "/number: new topic std_msgs/msg/Int32",
        "/other: new topic acme_msgs/msg/Pack",
        "/pack: missing topic acme_msgs/msg/Pack",
    ]


def test_changed_type_is_a_named_difference(tmp_path: Path) -> None:
    number = define("std_msgs/msg/Int32", "int32 data\n")
    differences = changes(tmp_path, lambda path: record(path, [("/pack", number, 1, {"data": 1})]))
    assert "/pack: changed type acme_msgs/msg/Pack → std_msgs/msg/Int32" in names(differences)
    assert any("changed ontology type" in message for message, _ in differences)


def test_difference_has_line_of_lock_file(tmp_path: Path) -> None:
    differences = changes(
        tmp_path, lambda path: make(path, PACK.replace("int32 cells", "int64 cells") + CELL)
    )
    lines = (tmp_path / "job.lock.json").read_text().splitlines()
    texts = {message: lines[line - 1].strip() for message, line in differences}
    assert texts == {
        "/pack: changed field acme_msgs/msg/Pack.cells: int32 → int64": '"int32 cells",',
        "/pack: changed column cells: int32 → int64": '"cells": "int32",',
    }


def test_changed_adapter_columns_are_named_differences(tmp_path: Path) -> None:
    make(tmp_path / "run.mcap")
    adapter = (
        "version: 1\nadapter: PackAdapter\nros_type: acme_msgs/msg/Pack\nontology: {tag: Pack, fields: {voltage: float32}}\n"
        "fields: {voltage: voltage}\n"
    )
    (tmp_path / "pack.yaml").write_text(adapter)
    manifest = job(tmp_path, f"{MANIFEST}adapters: {{load: [pack.yaml]}}\n")
    try:
        api.compile_job(manifest, locked=False)
    except IngestError as error:
        pytest.fail(str(error.findings or error))
    lock(manifest)
    (tmp_path / "pack.yaml").write_text(adapter.replace("float32", "float64"))
    with pytest.raises(ContractError) as error:
        make_plan(Task(api.compile_job(manifest)[0]))
    assert [f.message.partition(":")[2].split(" voltage")[0].strip() for f in error.value.findings] == [
        "changed column"
    ]


def test_run_with_difference_writes_nothing_and_exits_6(tmp_path: Path) -> None:
    changes(tmp_path, lambda path: make(path, number=1))
    manifest = tmp_path / "job.yaml"
    assert run_main("run", str(manifest), "-q") == 6
    assert run_main("plan", str(manifest)) == 6
    assert run_main("schema", "lock", "--check", str(manifest)) == 6
    assert not (tmp_path / "store" / "segments").exists()


def test_lock_check_writes_junit_and_sarif(tmp_path: Path) -> None:
    changes(tmp_path, lambda path: make(path, number=1))
    manifest, junit, sarif = (str(tmp_path / name) for name in ("job.yaml", "lock.xml", "lock.sarif"))
    check = ("schema", "lock", manifest, "--junit", junit, "--sarif", sarif)
    assert run_main(*check) == 2
    assert run_main(*check, "--check") == 6
    (case,) = ET.parse(junit).iterfind(".//testcase[failure]")  # noqa: S314 - our own file
    assert str(case.get("name")).startswith("definition-difference: /number")
    (result,) = json.loads(Path(sarif).read_text())["runs"][0]["results"]
    assert result["ruleId"] == "definition-difference"
    assert run_main("schema", "lock", manifest) == 0
    assert run_main(*check, "--check") == 0
    assert ET.parse(junit).find(".//failure") is None  # noqa: S314 - our own file
    assert json.loads(Path(sarif).read_text())["runs"][0]["results"] == []


def test_lock_topic_of_some_recordings_is_not_required(tmp_path: Path) -> None:
    make(tmp_path / "a.mcap", number=1)
    make(tmp_path / "b.mcap")
    manifest = job(tmp_path, MANIFEST.replace("run.mcap", '"*.mcap"'))
    document = json.loads(lock(manifest).read_text())
    assert {name: topic["required"] for name, topic in document["topics"].items()} == {
        "/number": False,
        "/pack": True,
    }
    assert run_main("schema", "lock", "--check", str(manifest)) == 0


def test_lock_of_differing_recordings_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "a.mcap")
    make(tmp_path / "b.mcap", PACK.replace("int32 cells", "int64 cells") + CELL)
    manifest = job(tmp_path, MANIFEST.replace("run.mcap", '"*.mcap"'))
    with pytest.raises(ContractError) as error:
        lock(manifest)
    assert len(error.value.findings) == 2
    assert not manifest.with_suffix(".lock.json").exists()


def test_missing_lock_file_has_same_rule_and_location_in_lint_and_compilation(tmp_path: Path) -> None:
    make(tmp_path / "run.mcap")
    manifest = job(tmp_path)
    with pytest.raises(ManifestError) as error:
        api.compile_job(manifest)
    findings = (*error.value.findings, *lint_paths([manifest], env={}).findings)
    assert [(f.rule, f.span.line, f.span.column) for f in findings if f.span] == [("lock-file", 3, 14)] * 2


def test_lint_invalid_lock_file_is_reported(tmp_path: Path) -> None:
    manifest = job(tmp_path)
    manifest.with_suffix(".lock.json").write_text('{"version": 1}')
    assert [finding.rule for finding in lint_paths([manifest], env={}).findings] == ["lock-file"]


def test_schema_lock_without_manifest_prints_schema(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_main("schema", "lock") == 0
    assert json.loads(capsys.readouterr().out) == document_schema(LockDocument)
    assert run_main("schema", "lock", "--check") == 2


def test_schema_lock_prints_differences_from_previous_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    changes(tmp_path, lambda path: make(path, number=1))
    assert run_main("schema", "lock", str(tmp_path / "job.yaml")) == 0
    assert capsys.readouterr().out.splitlines() == [
        "/number: new topic std_msgs/msg/Int32",
        f"{tmp_path / 'job.lock.json'}: 2 topics, 1 difference",
    ]


LINES = st.lists(
    st.tuples(st.sampled_from(["int32", "float64", "string"]), st.sampled_from("abcdef")),
    unique_by=lambda line: line[1],
    max_size=6,
)


@given(LINES, LINES)
def test_lock_differences_are_empty_only_for_equal_definitions(
    old: list[tuple[str, str]], new: list[tuple[str, str]]
) -> None:
    def document(lines: list[tuple[str, str]]) -> LockDocument:
        topic = LockedTopic(type="p/msg/A", definition="p/msg/A", ontology="o", columns={})
        text = tuple(f"{kind} {name}" for kind, name in lines)
        return LockDocument(topics={"/a": topic}, definitions={"p/msg/A": {"p/msg/A": text}})

    differences = lock_differences(document(old), document(new))
    assert (differences == ()) == (old == new)
    by_name = {name: kind for kind, name in old}
    changed = {name for kind, name in new if by_name.get(name, kind) != kind}
    assert len([one for one in differences if one.change is Change.CHANGED_FIELD]) == len(changed)
