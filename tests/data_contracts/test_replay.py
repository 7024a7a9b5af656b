"""`ingest replay` of a job with contracts: they describe recordings, not the rejected messages of a recording."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from mosaico_ingest.cli.app import main
from mosaico_ingest.destinations.store import Store

ROOT = Path(__file__).resolve().parents[2]
CONTRACTS = "expect: {topics: {/battery: {messages: {min: 10}, rejected: 50%}}}\ndefinitions: locked\n"


def exit_code(*words: str) -> int:
    with pytest.raises(SystemExit) as leave:
        main(list(words))
    return int(leave.value.code or 0)


def test_replay_of_job_with_contracts_adds_the_rejected_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    examples = Path("configs/examples")
    for name in ("quarantine.yaml", "replay.yaml"):
        manifest = examples / name
        manifest.write_text(manifest.read_text() + CONTRACTS)
        assert exit_code("schema", "lock", str(manifest)) == 0
    assert exit_code("run", "-q", str(examples / "quarantine.yaml")) == 4
    [command] = [
        line for line in (examples / "quarantine.yaml").read_text().splitlines() if "Then run:" in line
    ]
    assert exit_code(*command.partition("ingest ")[2].split(), "-q") == 0
    [sequence] = Store.open("mosaico").sequences()
    assert sequence.rows == 10
