"""Plan and report files: the models and the published schemas accept and reject the same documents."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any, TypeAlias

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from mosaico_ingest import api
from mosaico_ingest.documents import document_schema
from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.pipeline.plan_document import PlanDocument, read_plan
from mosaico_ingest.report.run import RunReport, read_report, report_schema

ROOT = Path(__file__).resolve().parents[1]
JOB = ROOT / "configs" / "quickstart.yaml"
DRIVE = ROOT / "configs" / "quickstart" / "drive.mcap"
Document: TypeAlias = dict[str, Any]
DocumentPath: TypeAlias = tuple[str | int, ...]
MODELS: dict[str, type[BaseModel]] = {"plan": PlanDocument, "report": RunReport}
SCHEMAS = {"plan": document_schema(PlanDocument), "report": report_schema()}
READERS: dict[str, Callable[[Path], object]] = {"plan": read_plan, "report": read_report}
COMPUTED = {"totals", "compression", "rate_hz", "exit_code"}
"""Fields that the models compute and ignore when a file is read."""


@pytest.fixture(scope="module")
def documents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Document]:
    """A plan, and a report with rejected rows and unreadable ranges."""
    folder = tmp_path_factory.mktemp("documents")
    bag = folder / "drive.mcap"
    bag.write_bytes(DRIVE.read_bytes()[: DRIVE.stat().st_size * 6 // 10])
    job = ROSInjectionConfig(
        bag,
        "drive",
        store=folder / "store",
        adapter_override={"/gps/fix": "GPSAdapter"},
        topics=("*", "!/camera/*"),
    )
    report = api.run([job], manifests=[api.used_manifest(JOB)])
    return {
        "plan": json.loads(api.plan_job(JOB, folder=JOB.parent).model_dump_json()),
        "report": json.loads(report.model_dump_json()),
    }


def locations(value: object, path: DocumentPath = ()) -> Iterator[DocumentPath]:
    """Yield the path of every value that is not computed."""
    if path:
        yield path
    items: list[tuple[str | int, object]] = []
    if isinstance(value, dict):
        items = [(key, item) for key, item in value.items() if key not in COMPUTED]
    elif isinstance(value, list):
        items = list(enumerate(value))
    for key, item in items:
        yield from locations(item, (*path, key))


def changed(document: Document, path: DocumentPath, change: str, value: object) -> Document:
    """Return a copy of a document in which the value at `path` is replaced, removed or renamed."""
    copy: Any = deepcopy(document)
    parent = copy
    for key in path[:-1]:
        parent = parent[key]
    if change == "replace":
        parent[path[-1]] = value
    elif change == "remove":
        del parent[path[-1]]
    elif isinstance(parent, dict):
        parent[f"{path[-1]}_"] = parent.pop(path[-1])
    return copy


def reader_accepts(kind: str, document: Document, file: Path) -> bool:
    file.write_text(json.dumps(document))
    try:
        READERS[kind](file)
    except ManifestError:
        return False
    return True


def model_accepts(kind: str, document: Document) -> bool:
    try:
        MODELS[kind].model_validate_json(json.dumps(document))
    except ValidationError:
        return False
    return True


@pytest.mark.parametrize("kind", sorted(MODELS))
def test_published_schema_is_current_and_accepts_document(kind: str, documents: dict[str, Document]) -> None:
    assert json.loads((ROOT / "schemas" / f"{kind}.schema.json").read_text()) == SCHEMAS[kind]
    jsonschema.Draft202012Validator(SCHEMAS[kind]).validate(documents[kind])
    assert model_accepts(kind, documents[kind])


@pytest.mark.parametrize("kind", sorted(MODELS))
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_reader_model_and_published_schema_accept_the_same_documents(
    kind: str, documents: dict[str, Document], tmp_path: Path, data: st.DataObject
) -> None:
    path = data.draw(st.sampled_from(sorted(locations(documents[kind]), key=str)))
    change = data.draw(st.sampled_from(["replace", "replace", "remove", "rename"]))
    value = data.draw(st.sampled_from([None, True, 7, -1, 0.5, "zzz", [], {}, ["a"], {"a": 1}, [1]]))
    if path[-1] == "started_at" and (change, value) == ("replace", "zzz"):
        return  # `format: date-time` is an annotation in JSON Schema; only the model checks it
    document = changed(documents[kind], path, change, value)
    accepted = jsonschema.Draft202012Validator(SCHEMAS[kind]).is_valid(document)
    assert reader_accepts(kind, document, tmp_path / "document.json") == accepted
    assert model_accepts(kind, document) or not accepted, "the schema must not accept more than the model"


@pytest.mark.parametrize(
    ("kind", "path", "value", "message"),
    [
        ("plan", ("recordings", 0, "plan", "topics", 1, "every"), "2", "$.recordings[0].plan.topics[1].every"),
        ("report", ("recordings", 0, "status"), "fine", "$.recordings[0].status"),
        ("report", ("recordings", 0, "duration_s"), "1", "$.recordings[0].duration_s"),
    ],
)  # fmt: skip
def test_read_of_invalid_document_states_json_path_and_keyword(
    kind: str,
    path: DocumentPath,
    value: object,
    message: str,
    *,
    documents: dict[str, Document],
    tmp_path: Path,
) -> None:
    file = tmp_path / "document.json"
    file.write_text(json.dumps(changed(documents[kind], path, "replace", value)))
    with pytest.raises(ManifestError) as raised:
        READERS[kind](file)
    assert raised.value.where == str(file)
    assert message in raised.value.what
    assert raised.value.what.endswith(("(type)", "(enum)"))


@pytest.mark.parametrize("kind", sorted(MODELS))
@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[]", b"null", b"[" * 100_000])
def test_read_of_file_that_is_no_document_fails(kind: str, content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "document.json"
    file.write_bytes(content)
    with pytest.raises(ManifestError):
        READERS[kind](file)
