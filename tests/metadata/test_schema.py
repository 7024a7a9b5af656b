"""Schema files: references, mistakes, and their locations."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.yaml_source import load_source
from mosaico_ingest.metadata import Spans, load_schema, schema_files, violations


def findings_of(folder: Path, schema: object, text: str) -> list[tuple[str, int, int]]:
    """Return message, line and column of the violations of a `metadata` mapping."""
    path = folder / "schema.json"
    path.write_text(json.dumps(schema))
    source = load_source(text, file="job.yaml")
    spans = Spans(source.spans, source.key_spans)
    metadata = source.at(("metadata",))
    assert isinstance(metadata, dict)
    actual = violations(load_schema(path), metadata, ("metadata",), spans)
    assert {finding.rule for finding in actual} <= {"metadata-schema"}
    return [(f.message, f.span.line, f.span.column) for f in actual if f.span]


def mistakes_of(path: Path) -> list[tuple[str, str, int, int]]:
    """Return rule, file name, line and column of the mistakes of a schema."""
    with pytest.raises(ManifestError) as error:
        load_schema(path)
    return [
        (f.rule, Path(f.span.file).name, f.span.line, f.span.column) for f in error.value.findings if f.span
    ]


@pytest.mark.parametrize(
    ("schema", "text", "location"),
    [
        ({"properties": {"a": {"type": "integer"}}}, "metadata:\n  a: x\n", (2, 6)),
        ({"properties": {"a": {"enum": ["x", "y"]}}}, "metadata: {b: 1, a: z}\n", (1, 21)),
        ({"properties": {"a": {"const": 1}}}, "metadata: {a: 2}\n", (1, 15)),
        ({"properties": {"a": {"pattern": "^r"}}}, "metadata: {a: x}\n", (1, 15)),
        ({"properties": {"a": {"format": "date"}}}, "metadata: {a: 2026-13-01}\n", (1, 15)),
        ({"properties": {"a": {"format": "date-time"}}}, "metadata: {a: soon}\n", (1, 15)),
        ({"properties": {"a": {"items": {"type": "string"}}}}, "metadata:\n  a:\n    - x\n    - 3\n", (4, 7)),
        ({"required": ["b"]}, "metadata: {a: 1}\n", (1, 1)),
        ({"properties": {"a": {"required": ["b"]}}}, "metadata:\n  a: {c: 1}\n", (2, 3)),
        ({"additionalProperties": False}, "metadata: {a: 1}\n", (1, 12)),
        ({"additionalProperties": {"type": "string"}}, "metadata: {a: 1}\n", (1, 15)),
        ({"patternProperties": {"^x": {}}, "additionalProperties": False}, "metadata: {xa: 1, b: 1}\n", (1, 19)),
        ({"properties": {"a": {"anyOf": [{"type": "null"}, {"type": "object", "properties": {"b": {"type": "null"}}}]}}},
         "metadata:\n  a: {b: 1}\n", (2, 10)),
        ({"unevaluatedProperties": False}, "metadata: {a: 1}\n", (1, 11)),
        ({"minProperties": 2}, "metadata: {a: 1}\n", (1, 11)),
    ],
)  # fmt: skip
def test_violations_have_location_of_value_or_key(
    tmp_path: Path, schema: object, text: str, location: tuple[int, int]
) -> None:
    assert [actual[1:] for actual in findings_of(tmp_path, schema, text)] == [location]


def test_violations_of_valid_metadata_are_empty(tmp_path: Path) -> None:
    schema = {"properties": {"a": {"format": "date-time"}, "b": {"type": "integer"}}, "required": ["a"]}
    assert findings_of(tmp_path, schema, "metadata: {a: '2026-03-01T12:00:00Z', b: 1, c: x}\n") == []


def test_violations_of_misspelled_required_key_are_one_finding_with_suggestion_and_fix(
    tmp_path: Path,
) -> None:
    path = tmp_path / "schema.json"
    path.write_text(
        '{"required": ["vehicle_id"], "properties": {"vehicle_id": {}}, "additionalProperties": false}'
    )
    source = load_source("metadata: {vehicleId: r1}\n", file="job.yaml")
    [finding] = violations(
        load_schema(path), {"vehicleId": "r1"}, ("metadata",), Spans(source.spans, source.key_spans)
    )
    assert finding.help is not None
    assert finding.help.startswith("did you mean 'vehicle_id'?")
    assert finding.fix is not None
    assert (finding.fix.text, finding.fix.span.column) == ("vehicle_id", 12)


def test_violations_of_endless_schema_are_a_finding(tmp_path: Path) -> None:
    assert [actual[1:] for actual in findings_of(tmp_path, {"$ref": "#"}, "metadata: {a: 1}\n")] == [(1, 11)]


def test_load_schema_follows_references_to_neighbors(tmp_path: Path) -> None:
    (tmp_path / "common").mkdir()
    (tmp_path / "common" / "id.json").write_text('{"$defs": {"id": {"$ref": "../word.json"}}}')
    (tmp_path / "word.json").write_text('{"type": "string"}')
    schema = {"properties": {"a": {"$ref": "common/id.json#/$defs/id"}}}
    assert [actual[1:] for actual in findings_of(tmp_path, schema, "metadata: {a: 1}\n")] == [(1, 15)]
    names = {path.name for path in schema_files(tmp_path / "schema.json")}
    assert names == {"schema.json", "id.json", "word.json"}


def test_load_schema_with_id_url_finds_neighbors(tmp_path: Path) -> None:
    (tmp_path / "word.json").write_text('{"$id": "https://fleet.example/word.json", "type": "string"}')
    schema = {"$id": "https://fleet.example/vehicle.json", "properties": {"a": {"$ref": "word.json"}}}
    assert [actual[1:] for actual in findings_of(tmp_path, schema, "metadata: {a: 1}\n")] == [(1, 15)]


def test_load_schema_reloads_changed_neighbor(tmp_path: Path) -> None:
    schema = {"properties": {"a": {"$ref": "word.json"}}}
    (tmp_path / "word.json").write_text('{"type": "string"}')
    assert len(findings_of(tmp_path, schema, "metadata: {a: 1}\n")) == 1
    (tmp_path / "word.json").write_text('{"type": "integer"}')
    assert findings_of(tmp_path, schema, "metadata: {a: 1}\n") == []


@pytest.mark.parametrize(
    ("text", "location"),
    [
        ('{"type": "strin"}', (1, 10)),
        ('{\n\t"type": "strin"\n}', (2, 10)),
        ('{"a": }', (1, 7)),
        ("[]", (1, 1)),
        ('{"$ref": "nowhere.json"}', (1, 10)),
        ('{"$ref": "https://fleet.example/x.json"}', (1, 10)),
        ('{"$ref": "#/$defs/x"}', (1, 10)),
        ('{"properties": {"a": {"$ref": "good.json#/$defs/x"}}}', (1, 31)),
    ],
)
def test_load_schema_mistake_has_location(tmp_path: Path, text: str, location: tuple[int, int]) -> None:
    (tmp_path / "good.json").write_text("{}")
    path = tmp_path / "bad.json"
    path.write_text(text)
    assert mistakes_of(path) == [("invalid-schema", "bad.json", *location)]


def test_load_schema_mistake_in_neighbor_has_its_location(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text('{\n  "minimum": "1"\n}')
    path = tmp_path / "schema.json"
    path.write_text('{"$ref": "bad.json"}')
    assert mistakes_of(path) == [("invalid-schema", "bad.json", 2, 14)]


def test_load_schema_ignores_references_in_data_and_property_names(tmp_path: Path) -> None:
    path = tmp_path / "schema.json"
    path.write_text('{"const": {"$ref": "x.json"}, "properties": {"$ref": {"type": "string"}}}')
    assert schema_files(path) == (path,)


def test_load_schema_missing_file_is_refused(tmp_path: Path) -> None:
    assert mistakes_of(tmp_path / "x.json") == [("invalid-schema", "x.json", 1, 1)]
