"""Findings for manifests with one misspelled key or one wrong value."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import jsonschema
import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mosaico_ingest.job.manifest import check_manifest
from mosaico_ingest.job.reference import job_schema
from mosaico_ingest.job.yaml_source import (
    KeyPath,
    Source,
    Value,
    load_source,
)

GOOD = """\
version: 1
bag:
  path: data/session_01.db3
  ros_distro: ros2_humble
  custom_msgs:
  - package: my_custom_pkg
    path: definitions/my_pkg
    store: ros2_humble
  time:
    start: +10s
    end: 2026-03-01T12:00:00Z
sequence:
  name: run_01
  metadata_file: metadata.json
  if_exists: append
topics:
- /cam*
topic_settings:
  /imu:
    rename: /sensors/imu
    every: 3
    image: png
adapters:
  load:
  - adapters/battery_pack.yaml
  override:
    /lidar: LidarAdapter
  unmodeled: keep
on_error:
  session: report
  topic: raise
  message: log_warn
target:
  host: mosaico.example.org
  port: 6726
  api_key: key
  tls_cert: certs/ca.pem
  tls: true
run:
  jobs: 2
  memory: 512MiB
  report: report.json
  log_level: INFO
"""
FREE = {("topic_settings", "/imu"), ("adapters", "override", "/lidar")}
WRONG = [("7", 7), ("1.5", 1.5), ("[a]", ["a"]), ("{a: b}", {"a": "b"}), ("true", True), ("'zzz'", "zzz")]
SCHEMA = jsonschema.Draft202012Validator(job_schema())


def walk(value: Value, path: KeyPath = ()) -> Iterator[KeyPath]:
    if path:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from walk(inner, (*path, key))


SOURCE = load_source(GOOD, file="j")
PATHS = list(walk(SOURCE.value))
KEYS = [path for path in PATHS if isinstance(path[-1], str) and path not in FREE]
LEAVES = [path for path in PATHS if not isinstance(SOURCE.at(path), dict | list)]


def name(path: KeyPath) -> str:
    return ".".join(str(part) for part in path)


def replaced(start: tuple[int, int], end: tuple[int, int], new: str) -> str:
    lines = GOOD.splitlines(keepends=True)
    assert start[0] == end[0]
    line = lines[start[0] - 1]
    lines[start[0] - 1] = line[: start[1] - 1] + new + line[end[1] - 1 :]
    return "".join(lines)


def findings_of(text: str) -> list[tuple[str, int, int, str]]:
    _, findings = check_manifest(load_source(text, file="j"), env={})
    return [(f.rule, f.span.line, f.span.column, f.help or "") for f in findings if f.span is not None]


def test_check_manifest_unmutated_manifest_has_no_findings() -> None:
    assert findings_of(GOOD) == []
    SCHEMA.validate(SOURCE.value)


@pytest.mark.parametrize("path", KEYS, ids=name)
@pytest.mark.parametrize("slip", ["double", "drop", "upper"])
def test_check_manifest_misspelled_key_is_located_and_corrected(path: KeyPath, slip: str) -> None:
    key = str(path[-1])
    wrong = {"double": key + key[-1], "drop": key[:-1], "upper": key.upper()}[slip]
    span = SOURCE.key_span(path)
    actual = findings_of(replaced((span.line, span.column), (span.end_line, span.end_column), wrong))
    assert [(rule, line, column) for rule, line, column, _ in actual] == [
        ("unknown-key", span.line, span.column)
    ]
    assert f"did you mean '{key}'" in actual[0][3]


def cases() -> Iterator[tuple[KeyPath, str]]:
    for path in LEAVES:
        for written, value in WRONG:
            if schema_refuses(path, value):
                yield path, written


def schema_refuses(path: KeyPath, value: object) -> bool:
    document = yaml.safe_load(yaml.safe_dump(SOURCE.value))
    parent = document
    for part in path[:-1]:
        parent = parent[part]
    parent[path[-1]] = value
    return not SCHEMA.is_valid(document)


@pytest.mark.parametrize(
    ("path", "written"), list(cases()), ids=lambda part: name(part) if isinstance(part, tuple) else part
)
def test_check_manifest_wrong_value_is_one_located_finding(path: KeyPath, written: str) -> None:
    span = SOURCE.span(path)
    text = replaced((span.line, span.column), (span.end_line, span.end_column), written)
    actual = findings_of(text)
    if written.startswith("{"):  # a mapping with another key also lacks the required ones
        actual = [finding for finding in actual if finding[0] != "missing-key"]
    assert len(actual) == 1
    rule, line, column, remedy = actual[0]
    assert rule in {"wrong-type", "wrong-value", "newer-version", "unknown-key"}
    assert line == span.line
    assert column >= span.column
    assert remedy


@pytest.mark.parametrize("path", LEAVES, ids=name)
@pytest.mark.parametrize("written", [written for written, _ in WRONG])
def test_check_manifest_mutated_value_agrees_with_json_schema(path: KeyPath, written: str) -> None:
    span = SOURCE.span(path)
    text = replaced((span.line, span.column), (span.end_line, span.end_column), written)
    source = load_source(text, file="j")
    refused = bool(findings_of(text))
    assert refused == (not SCHEMA.is_valid(source.value)) or is_about_one_another(source)


def is_about_one_another(source: Source) -> bool:
    """Return whether a document has a text that JSON Schema cannot check beyond its pattern."""
    return bool(re.search("zzz", json.dumps(source.value)))


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-2, 2**70),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from(
        ["", "1", "1.5", "true", "no", "5s", "10MB", "1 %", "2026-01-01", "ignore", "/imu", "${X}"]
    ),
)
VALUES = st.one_of(
    SCALARS,
    st.lists(SCALARS, max_size=2),
    st.dictionaries(st.sampled_from(["a", "/imu", "default"]), SCALARS),
)
OPTIONAL = [
    (name, *inner)
    for name, section in SCHEMA.schema["properties"].items()
    for inner in (
        (),
        *(
            (key,)
            for key in SCHEMA.schema["$defs"].get(str(section.get("$ref", ""))[8:], {}).get("properties", ())
        ),
    )
]


@settings(deadline=None, max_examples=600)
@example(path=("quarantine",), value=None)
@example(path=("run", "jobs"), value="2")
@given(path=st.sampled_from(list(dict.fromkeys([*PATHS, *OPTIONAL]))), value=VALUES)
def test_check_manifest_accepts_no_value_that_the_schema_rejects(path: KeyPath, value: Value) -> None:
    document = json.loads(json.dumps(SOURCE.value))
    parent = document
    for part in path[:-1]:
        parent = parent[part] if isinstance(parent, list) else parent.setdefault(part, {})
        if not isinstance(parent, dict | list):
            return
    parent[path[-1]] = value
    _, findings = check_manifest(load_source(json.dumps(document), file="j"), env={"X": "x"})
    assert findings or SCHEMA.is_valid(document)
