from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosaico_ingest.ontology.registry import MODULES, model, ontology_type

GOLDEN: dict[str, list[str]] = json.loads(Path(__file__).with_name("fingerprints.json").read_text())


@pytest.mark.parametrize("tag", sorted(MODULES))
def test_ontology_fingerprints_and_formats_are_unchanged(tag: str) -> None:
    ontology = ontology_type(tag)
    assert [ontology.fingerprint, ontology.serialization_format.value] == GOLDEN[tag]
    assert ontology.tag == tag


def test_ontology_fingerprints_cover_every_model() -> None:
    assert set(GOLDEN) == set(MODULES)


@pytest.mark.parametrize("tag", sorted(MODULES))
def test_columns_json_entry_matches_model(tag: str) -> None:
    known, result = ontology_type(tag), model(tag).ontology_type()
    assert known == result
    assert known.struct.equals(result.struct, check_metadata=True)


def test_ontology_columns_equal_reference(shared: Path) -> None:
    reference = json.loads((shared / "spec" / "ontology.json").read_text())["classes"]
    assert {entry["ontology_tag"] for entry in reference} == set(MODULES)
    for entry in reference:
        ontology = ontology_type(entry["ontology_tag"])
        assert str(ontology.struct) == entry["arrow_type_str"]
        assert ontology.fingerprint == entry["schema_fingerprint"]
        assert ontology.serialization_format.value == entry["serialization_format"]


def values(data_type: pa.DataType) -> st.SearchStrategy[Any]:
    """Return values that fit a column's type."""
    if pa.types.is_struct(data_type):
        fields = {field.name: field for field in data_type}
        return st.fixed_dictionaries({name: values(field.type) for name, field in fields.items()})
    if pa.types.is_fixed_size_list(data_type):
        return st.lists(
            values(data_type.value_type), min_size=data_type.list_size, max_size=data_type.list_size
        )
    if pa.types.is_list(data_type):
        return st.lists(values(data_type.value_type), max_size=3)
    if pa.types.is_integer(data_type):
        width = data_type.bit_width
        low, high = (
            (-(2 ** (width - 1)), 2 ** (width - 1))
            if pa.types.is_signed_integer(data_type)
            else (0, 2**width)
        )
        return st.integers(low, high - 1)
    if pa.types.is_floating(data_type):
        return st.floats(width=data_type.bit_width, allow_nan=False)
    return {pa.string(): st.text(), pa.binary(): st.binary(), pa.bool_(): st.booleans()}[data_type]


SPECIAL = {"Unmodeled", "Range", "Image", "CompressedImage", "PointCloud2", "PointField"}
"""Models whose values have rules beyond their column types."""


def within_a_second(value: Any) -> Any:
    """Reduce every `nanoseconds` to less than one second."""
    if isinstance(value, dict):
        return {k: v % 10**9 if k == "nanoseconds" else within_a_second(v) for k, v in value.items()}
    return [within_a_second(item) for item in value] if isinstance(value, list) else value


@pytest.mark.parametrize("tag", sorted(set(MODULES) - SPECIAL))
@settings(deadline=None, max_examples=5)
@given(data=st.data())
def test_model_row_round_trip_restores_row(tag: str, data: st.DataObject) -> None:
    ontology = model(tag)
    row = within_a_second(data.draw(values(ontology_type(tag).struct)))
    batch = ontology.to_batch([ontology.from_row(row)])
    assert batch.type == ontology_type(tag).struct
    assert batch[0].as_py() == row
