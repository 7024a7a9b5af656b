"""Errors: their text has one line, pickling keeps their fields, and they have the documented exit codes."""

from __future__ import annotations

import pickle

import pytest

from mosaico_ingest import errors
from mosaico_ingest.errors import (
    IngestError,
    ManifestError,
    SinkUnavailable,
    Unreachable,
)
from mosaico_ingest.findings import Finding, Severity

KINDS = [getattr(errors, name) for name in errors.__all__]
FINDING = Finding("unknown-key", Severity.ERROR, "unknown key")


@pytest.mark.parametrize("kind", KINDS)
def test_error_pickled_keeps_its_fields(kind: type[IngestError]) -> None:
    error = pickle.loads(pickle.dumps(kind("it broke", where="job.yaml:1:2", hint="fix it")))  # noqa: S301 - our own bytes
    assert type(error) is kind
    assert str(error) == "job.yaml:1:2: it broke — fix it"
    assert error.args == ("it broke",)


def test_error_pickled_keeps_its_findings() -> None:
    error = pickle.loads(pickle.dumps(ManifestError("two problems", findings=(FINDING,))))  # noqa: S301 - our own bytes
    assert error.findings == (FINDING,)


def test_only_unavailable_and_unreachable_errors_are_retryable() -> None:
    assert [kind for kind in KINDS if kind.retryable] == [SinkUnavailable, Unreachable]


def test_exit_codes_equal_the_documented_ones() -> None:
    codes = {kind.__name__: kind.exit_code for kind in KINDS}
    assert codes["ManifestError"] == 2
    assert codes["NothingMatched"] == 3
    assert codes["VerificationError"] == 5
    assert codes["Interrupted"] == 130
    assert codes["BagError"] == codes["SinkError"] == codes["AdapterError"] == 1
