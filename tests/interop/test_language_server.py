"""The published schemas in an editor: a YAML language server completes and explains keys."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
SERVER = shutil.which("yaml-language-server")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        SERVER is None, reason="yaml-language-server is not on the PATH (npm install -g yaml-language-server)"
    ),
]


class Server:
    """Just enough of the protocol to ask about one document."""

    def __init__(self, folder: Path) -> None:
        assert SERVER is not None
        self._process = subprocess.Popen([SERVER, "--stdio"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # noqa: S603 - a fixed command
        self._number = 0
        self.ask("initialize", {"processId": None, "rootUri": folder.as_uri(), "capabilities": {}})
        self._send({"method": "initialized", "params": {}})
        settings = {
            "yaml": {"completion": True, "hover": True, "validate": True, "schemaStore": {"enable": False}}
        }
        self._send({"method": "workspace/didChangeConfiguration", "params": {"settings": settings}})

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()

    def open(self, path: Path, text: str) -> str:
        document = {"uri": path.as_uri(), "languageId": "yaml", "version": 1, "text": text}
        self._send({"method": "textDocument/didOpen", "params": {"textDocument": document}})
        return document["uri"]

    def ask(self, method: str, params: dict[str, Any]) -> Any:
        self._number += 1
        self._send({"id": self._number, "method": method, "params": params})
        while True:
            message = self._receive()
            if message.get("id") == self._number and "method" not in message:
                return message["result"]
            if "id" in message:  # the server asks for its configuration
                items = message.get("params", {}).get("items", [])
                self._send({"id": message["id"], "result": [None] * len(items)})

    def at(self, method: str, uri: str, line: int, column: int) -> Any:
        position = {"line": line - 1, "character": column - 1}
        return self.ask(f"textDocument/{method}", {"textDocument": {"uri": uri}, "position": position})

    def _send(self, message: dict[str, Any]) -> None:
        body = json.dumps({"jsonrpc": "2.0", **message}).encode()
        assert self._process.stdin is not None
        self._process.stdin.write(b"Content-Length: %d\r\n\r\n%s" % (len(body), body))
        self._process.stdin.flush()

    def _receive(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        length = 0
        while line := self._process.stdout.readline().strip():
            name, _, value = line.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        return json.loads(self._process.stdout.read(length))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    shutil.copytree(ROOT / "schemas", tmp_path / "schemas")
    server = Server(tmp_path)
    yield server
    server.close()


def test_language_server_completes_and_explains_manifest_keys(server: Server, tmp_path: Path) -> None:
    modeline = f"# yaml-language-server: $schema={(tmp_path / 'schemas' / 'job.schema.json').as_uri()}"
    text = f"{modeline}\nbag:\n  path: x.mcap\n  ros_distro: \nsequence:\n  \n"
    uri = server.open(tmp_path / "job.yaml", text)
    keys = {item["label"] for item in server.at("completion", uri, 6, 3)["items"]}
    assert {"name", "metadata", "metadata_file", "if_exists"} <= keys
    distros = {item["label"].strip('"') for item in server.at("completion", uri, 4, 15)["items"]}
    assert {"ros1_noetic", "ros2_humble"} <= distros
    hover = json.dumps(server.at("hover", uri, 3, 4), ensure_ascii=False)
    assert "the parts of one recording" in hover


def test_language_server_completes_adapter_keys(server: Server, tmp_path: Path) -> None:
    modeline = f"# yaml-language-server: $schema={(tmp_path / 'schemas' / 'adapter.schema.json').as_uri()}"
    uri = server.open(tmp_path / "pack.yaml", f"{modeline}\nversion: 1\nadapter: A\n\n")
    keys = {item["label"] for item in server.at("completion", uri, 4, 1)["items"]}
    assert {"ros_type", "ontology", "fields", "tests"} <= keys
