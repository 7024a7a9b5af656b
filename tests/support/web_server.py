"""A web server that sends files by range, and fails on request."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol, TypeVar


@dataclass
class WebServer:
    """The state of a running server; tests change it between requests."""

    port: int = 0
    files: dict[str, bytes] = field(default_factory=dict[str, bytes])
    """Content by path; the server sends it only to requests with the query."""
    query: str = ""
    tag: str = "v1"
    ranges: bool = True
    """Whether the server obeys ranges."""
    failures: list[int] = field(default_factory=list[int])
    """Status codes of the next responses."""
    expires_after: int | None = None
    """Number of responses after which the server refuses access."""
    delay_s: float = 0.0
    requests: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """Method and range of each request."""
    sent_bytes: int = 0

    def url(self, name: str) -> str:
        """Return the URL of a file."""
        return f"http://127.0.0.1:{self.port}/{name}" + (f"?{self.query}" if self.query else "")


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    state: WebServer

    def log_message(self, *_: Any) -> None:
        """Print nothing."""

    def do_GET(self) -> None:
        state = self.state
        byte_range = self.headers.get("Range", "")
        state.requests.append((self.command, byte_range))
        time.sleep(state.delay_s)
        path, _, query = self.path[1:].partition("?")
        if state.failures:
            self.reply(state.failures.pop(0), b"")
        elif query != state.query or (state.expires_after is not None and state.expires_after <= 0):
            self.reply(403, b"expired")
        elif path not in state.files:
            self.reply(404, b"")
        else:
            self.send_content(state.files[path], byte_range)
        if state.expires_after is not None:
            state.expires_after -= 1

    def send_content(self, content: bytes, byte_range: str) -> None:
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", byte_range)
        if match is None or not self.state.ranges:
            self.reply(200, content)
            return
        start, stop = int(match[1]), min(int(match[2]) + 1, len(content))
        if start >= len(content):
            self.reply(416, b"", f"bytes */{len(content)}")
        else:
            self.reply(206, content[start:stop], f"bytes {start}-{stop - 1}/{len(content)}")

    def reply(self, status: int, body: bytes, content_range: str = "") -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("ETag", f'"{self.state.tag}"')
        if content_range:
            self.send_header("Content-Range", content_range)
        self.end_headers()
        try:
            self.wfile.write(body)
        except OSError:
            return  # the client has read enough
        self.state.sent_bytes += len(body)


@contextmanager
def web_server() -> Iterator[WebServer]:
    """Run a server in a thread."""
    with serving(_Handler, WebServer()) as state:
        yield state


class _State(Protocol):
    port: int


State = TypeVar("State", bound=_State)


@contextmanager
def serving(handler: type[BaseHTTPRequestHandler], state: State) -> Iterator[State]:
    """Answer requests in a thread; the handler has the state as an attribute, and the state knows the port."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (handler,), {"state": state}))
    server.daemon_threads = True
    state.port = server.server_port
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield state
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
