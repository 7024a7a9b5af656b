"""An S3 server in a process of its own, which counts what it is asked, and can be told to be gone."""

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
    """What the server did since it was last asked."""

    requests: list[str]
    """Each as method and path."""
    sent_bytes: int


@dataclass
class ObjectStore:
    """A running server; what it does is counted until `counts` is asked for."""

    process: subprocess.Popen[str]
    port: int

    def url(self, key: str) -> str:
        """Return the URL of an object, with what it takes to reach this server."""
        return f"s3://{BUCKET}/{key}?endpoint_override=127.0.0.1:{self.port}&scheme=http&region=us-east-1"

    def counts(self) -> Counts:
        """Return what was asked since the last time, and forget it."""
        return Counts(**self._control("counts"))

    def fail_after(self, requests: int, *, containing: str = "") -> None:
        """Let the server die after so many more requests whose line has this text."""
        self._control(f"fail?{requests}&{quote(containing)}")

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)

    def _control(self, what: str) -> Any:
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{CONTROL}{what}", timeout=10) as answer:
            return json.load(answer)


@contextmanager
def object_store() -> Iterator[ObjectStore]:
    """Run a server with one empty bucket."""
    command = [sys.executable, "-W", "ignore", str(Path(__file__))]
    environment = {**os.environ, **CREDENTIALS}
    with subprocess.Popen(  # noqa: S603 - this very file
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
            with urllib.request.urlopen(request, timeout=10):  # noqa: S310 - the same
                return
        except OSError:  # noqa: PERF203 - it may not listen yet
            if time.monotonic() > deadline:
                raise
            time.sleep(0.1)


@dataclass
class _Counting:
    """Stands in front of the server."""

    app: Wsgi
    asked: list[str] = field(default_factory=list[str])
    sent: int = 0
    dies: tuple[int, str] | None = None

    def __call__(self, environ: Mapping[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
        path, query = environ["PATH_INFO"], environ.get("QUERY_STRING", "")
        if path.startswith(CONTROL):
            start("200 OK", [("Content-Type", "application/json")])
            return [self._control(path.removeprefix(CONTROL), query).encode()]
        line = f"{environ['REQUEST_METHOD']} {path}{'?' if query else ''}{query}"
        self.asked.append(line)
        if self.dies and self.dies[1] in line:
            if self.dies[0] <= 0:
                os._exit(1)
            self.dies = (self.dies[0] - 1, self.dies[1])
        return self._counted(self.app(environ, start))

    def _counted(self, pieces: Iterable[bytes]) -> Iterator[bytes]:
        for piece in pieces:
            self.sent += len(piece)
            yield piece

    def _control(self, what: str, query: str) -> str:
        if what == "fail":
            count, _, text = query.partition("&")
            self.dies = (int(count), unquote(text))
            return "{}"
        said = json.dumps({"requests": self.asked, "sent_bytes": self.sent})
        self.asked, self.sent = [], 0
        return said


def _serve() -> None:
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app  # noqa: PLC0415 - only the server has it
    from werkzeug.serving import make_server  # noqa: PLC0415 - the same

    app = _Counting(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True)
    sys.stdout.write(f"{server.port}\n")
    sys.stdout.flush()
    server.serve_forever()


if __name__ == "__main__":
    _serve()
