"""The contracts of docs/contracts.md are valid sections of a manifest."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest
import yaml

from mosaico_ingest.lint.engine import lint_paths

PAGE = Path(__file__).resolve().parents[2] / "docs" / "contracts.md"
BLOCKS = [
    textwrap.dedent(block)
    for block in re.findall(
        r"^ *```yaml\n(.*?)^ *```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
]
CONTRACTS = [block for block in BLOCKS if block.startswith("expect:")]


def test_page_has_ten_contracts_and_valid_yaml() -> None:
    assert len(CONTRACTS) == 10
    assert all(isinstance(yaml.safe_load(block), dict) for block in BLOCKS)


@pytest.mark.parametrize("contract", CONTRACTS)
def test_contract_of_page_has_no_finding(contract: str, tmp_path: Path) -> None:
    manifest = tmp_path / "job.yaml"
    manifest.write_text(f'bag: {{path: "data/*.mcap"}}\n{contract}')
    assert [str(finding) for finding in lint_paths([manifest], env={}).findings] == []
