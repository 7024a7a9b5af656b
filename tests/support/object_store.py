"""An S3 server in its own process that counts requests and can be stopped on request."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "test",
    "AWS_SECRET_ACCESS_KEY": "test",
    "AWS_EC2_METADATA_DISABLED": "true",
}
BUCKET = "bucket"
START_S = 60.0
CONTROL = "/-/"

Wsgi = Callable[[Mapping[str, Any], Callable[..., Any]], Iterable[bytes]]


@dataclass(frozen=True)
class Counts:
    """The activity of the server since the last query."""

    requests: list[str]
    """Method and path of each request."""
    sent_bytes: int


@dataclass
class ObjectStore:
    """A running server that counts requests until `counts` is called."""

    process: subprocess.Popen[str]
    port: int

    def url(self, key: str) -> str:
        """Return the URL of an object with the options for this server."""
        return f"s3://{BUCKET}/{key}?endpoint_override=127.0.0.1:{self.port}&scheme=http&region=us-east-1"

    def counts(self) -> Counts:
        """Return the counts since the last call, and reset them."""
        return Counts(**self._control("counts"))

    def fail_after(self, requests: int, *, containing: str = "") -> None:
        """Let the server exit after `requests` more requests whose line contains a text."""
        self._control(f"fail?{requests}&{quote(containing)}")

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)

    def _control(self, command: str) -> Any:
        with urllib.request.urlopen(
            f"http://127.0.0.1:{self.port}{CONTROL}{command}", timeout=10
        ) as response:
            return json.load(response)


@contextmanager
def object_store() -> Iterator[ObjectStore]:
    """Run a server with an empty bucket."""
    command = [sys.executable, "-W", "ignore", str(Path(__file__))]
    environment = {**os.environ, **CREDENTIALS}
    with subprocess.Popen(  # noqa: S603 - this file
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            running = ObjectStore(process, int(process.stdout.readline()))
            _make_bucket(running)
            yield running
        finally:
            process.kill()
            process.wait(10)


def _make_bucket(running: ObjectStore) -> None:
    request = urllib.request.Request(f"http://127.0.0.1:{running.port}/{BUCKET}", method="PUT")
    deadline = time.monotonic() + START_S
    while True:
        try:
            with urllib.request.urlopen(request, timeout=10):  # noqa: S310 - our own server
                return
        except OSError:  # noqa: PERF203 - the server may not listen yet
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


@dataclass
class _Counting:
    """WSGI middleware that counts requests and can exit."""

    app: Wsgi
    requests: list[str] = field(default_factory=list[str])
    sent: int = 0
    exit_after: tuple[int, str] | None = None

    def __call__(self, environ: Mapping[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        path, query = environ["PATH_INFO"], environ.get("QUERY_STRING", "")
        if path.startswith(CONTROL):
            start("200 OK", [("Content-Type", "application/json")])
            return [self._control(path.removeprefix(CONTROL), query).encode()]
        line = f"{environ['REQUEST_METHOD']} {path}{'?' if query else ''}{query}"
        self.requests.append(line)
        if self.exit_after and self.exit_after[1] in line:
            if self.exit_after[0] <= 0:
                os._exit(1)
            self.exit_after = (self.exit_after[0] - 1, self.exit_after[1])
        return self._counted(self.app(environ, start))

    def _counted(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        for piece in pieces:
            self.sent += len(piece)
            yield piece

    def _control(self, command: str, query: str) -> str:
        if command == "fail":
            count, _, text = query.partition("&")
            self.exit_after = (int(count), unquote(text))
            return "{}"
        counts = json.dumps({"requests": self.requests, "sent_bytes": self.sent})
        self.requests, self.sent = [], 0
        return counts


def _serve() -> None:
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app  # noqa: PLC0415 - only the server process needs it
    from werkzeug.serving import make_server  # noqa: PLC0415 - only the server process needs it

    app = _Counting(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True)
    sys.stdout.write(f"{server.port}\n")
    sys.stdout.flush()
    server.serve_forever()


if __name__ == "__main__":
    _serve()
