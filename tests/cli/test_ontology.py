"""`ingest ontology`, and the proposals of ontology tags and adapters in editors and shells."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest

from mosaico_ingest.cli.app import completer, main
from mosaico_ingest.ontology.registry import DEFINED, MODULES, ontology_type
from mosaico_ingest.services.schemas import adapter_editor_schema, job_editor_schema


def ingest(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as leave:
        main(["ontology", *arguments])
    out, err = capsys.readouterr()
    return int(leave.value.code or 0), out, err


def test_ls_lists_every_tag_or_tags_that_match_glob(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for tag in DEFINED.keys() - MODULES:  # of models that other tests define
        monkeypatch.delitem(DEFINED, tag)
    code, out, _ = ingest(capsys, "ls", "--json")
    assert code == 0
    assert set(MODULES) <= {one["tag"] for one in json.loads(out)}
    code, out, _ = ingest(capsys, "ls", "*image", "--json")
    assert [one["tag"] for one in json.loads(out)] == ["CompressedImage", "Image"]
    assert ingest(capsys, "ls", "nothing*")[0] == 3


def test_show_has_units_and_nullability_of_nested_fields(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = ingest(capsys, "show", "FrameTransform", "--json")
    assert code == 0
    fields = {field["name"]: field for field in json.loads(out)["fields"]}
    assert fields["transforms[].translation.x"]["unit"] == "m"
    assert fields["transforms[].translation.x"]["type"] == "float64"
    top = {field.name: field.nullable for field in ontology_type("FrameTransform").struct}
    assert {name: fields[name]["nullable"] for name in top} == top
    assert "nullable" in ingest(capsys, "show", "IMU")[1]


def test_show_unknown_tag_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = ingest(capsys, "show", "IMX")
    assert code == 1
    assert "did you mean IMU" in err


def test_shell_proposes_tags() -> None:
    complete = completer("TAG")
    assert complete is not None

    context: Any = SimpleNamespace(params={})
    assert complete(context, None, "Compressed") == ["CompressedImage"]


def test_editor_schemas_propose_names_and_accept_others() -> None:
    adapter = {
        "version": 1,
        "adapter": "A",
        "ros_type": "a/msg/B",
        "fields": {"p": {"use": "OwnAdapter", "of": "x"}},
    }
    for ontology in ("IMU", "Own"):
        jsonschema.validate({**adapter, "ontology": ontology}, adapter_editor_schema())
    assert "IMU" in json.dumps(adapter_editor_schema()["properties"]["ontology"])
    job = {"bag": {"path": "a.mcap"}, "adapters": {"override": {"/a": "LidarAdapter", "/b": "b.yaml"}}}
    jsonschema.validate(job, job_editor_schema())
    assert "LidarAdapter" in json.dumps(
        job_editor_schema()["$defs"]["AdapterSettings"]["properties"]["override"]["additionalProperties"]
    )
