"""The composed manifest of a report, without secrets."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from mosaico_ingest.job.reference import MASK, manifest_text

SECRETS = (
    "target: {host: h, api_key: hunter2}",
    'target: {host: h, api_key: "${K:-hunter2}"}',
    'defaults: {K: hunter2}\ntarget: {host: h, api_key: "${K}"}',
    "matrix: {api_key: [hunter2]}",
    "sequence: {metadata: {Token: {of: [hunter2]}}}",
    "sequence: {metadata: {note: we use msco_hunter2_1}}",
    "bag: {path: 's3://me:hunter2@bucket/a.mcap'}",
    "bag: {path: 's3://bucket/a.mcap?secret_key=hunter2&region=x'}",
    "target:\n  host: h\n  api_key: >-\n    hunter2",
)


@pytest.mark.parametrize("text", SECRETS)
def test_manifest_text_with_secret_masks_it(text: str, tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(text)
    shown = manifest_text(tmp_path / "job.yaml")
    assert "hunter2" not in shown
    assert MASK in shown or "${K}" in shown


def test_manifest_text_extended_file_is_merged_with_location(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("run: {jobs: 2}\n")
    (tmp_path / "job.yaml").write_text('extends: base.yaml\nbag: {path: "${DIR}/*.mcap"}\n')
    shown = manifest_text(tmp_path / "job.yaml")
    assert yaml.safe_load(shown) == {"bag": {"path": "${DIR}/*.mcap"}, "run": {"jobs": 2}}
    assert f"jobs: 2  # {tmp_path / 'base.yaml'}:1" in shown
