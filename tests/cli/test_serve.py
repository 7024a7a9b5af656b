"""`ingest serve`, with keys, as the destination of `ingest bag`: what is written there is what the store then holds."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path

import pytest

from mosaico_ingest.store import Store

ROOT = Path(__file__).resolve().parents[2]
RECORDING = ROOT / "configs" / "quickstart" / "drive.mcap"


def ingest(*arguments: str, cwd: Path, key: str | None = None) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, **({"MOSAICO_API_KEY": key} if key else {})}
    return subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def served(tmp_path: Path) -> Generator[tuple[Path, str, str]]:
    """A folder, the port of a server over its store, and a key that may write."""
    key = ingest("keys", "new", "--permission", "write", cwd=tmp_path).stdout.strip()
    command = [sys.executable, "-m", "mosaico_ingest", "serve", "--port", "0", "--api-keys", "api_keys.json"]
    server = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own command
    assert server.stdout is not None
    port = re.search(r":(\d+)$", server.stdout.readline())
    assert port is not None
    yield tmp_path, port[1], key
    server.send_signal(signal.SIGTERM)
    assert server.wait(timeout=20) == 0
    server.stdout.close()


def test_a_recording_goes_to_the_server_and_is_in_its_store(served: tuple[Path, str, str]) -> None:
    folder, port, key = served
    arguments = ("bag", str(RECORDING), "--name", "drive", "--host", "127.0.0.1", "--port", port)
    done = ingest(*arguments, cwd=folder, key=key)
    assert done.returncode == 0, done.stderr
    assert key not in done.stdout + done.stderr
    topics = Store.open(folder / "mosaico", create=False).sequence("drive").topics
    assert sum(topic.rows for topic in topics) == 2130


def test_a_key_that_may_only_read_is_refused_at_once(served: tuple[Path, str, str]) -> None:
    folder, port, _ = served
    key = ingest("keys", "new", "--permission", "read", "--api-keys", "other.json", cwd=folder).stdout.strip()
    arguments = ("bag", str(RECORDING), "--name", "drive", "--host", "127.0.0.1", "--port", port)
    done = ingest(*arguments, cwd=folder, key=key)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert key not in done.stdout + done.stderr


def test_keys_are_listed_without_being_shown(served: tuple[Path, str, str]) -> None:
    folder, _, key = served
    listed = ingest("keys", "ls", cwd=folder).stdout
    assert "write" in listed
    assert key not in listed


def test_a_certificate_without_its_key_is_refused(tmp_path: Path) -> None:
    done = ingest("serve", "--tls-cert", "cert.pem", cwd=tmp_path)
    assert done.returncode == 2
    assert "--tls-key" in done.stderr


def test_help_of_the_server_names_its_options(tmp_path: Path) -> None:
    done = ingest("serve", "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "--api-keys" in done.stdout
