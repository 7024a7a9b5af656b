"""A minimal Azure Blob Storage: one account, blobs in memory, failures on request."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email.utils import formatdate
from hashlib import sha256
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

from web_server import serving

ACCOUNT = "account"
CONTAINER = "container"


@dataclass
class BlobService:
    """The state of a running service; tests change it between requests."""

    port: int = 0
    blobs: dict[str, bytes] = field(default_factory=dict[str, bytes])
    blocks: dict[str, bytes] = field(default_factory=dict[str, bytes])
    failures: list[int] = field(default_factory=list[int])
    """Status codes of the next responses."""
    delay_s: float = 0.0
    requests: list[str] = field(default_factory=list[str])
    """Method and path of each request."""

    def url(self, name: str, container: str = CONTAINER) -> str:
        """Return the URL of a blob with the options for this service."""
        options = f"account_name={ACCOUNT}&endpoint_override=127.0.0.1:{self.port}&scheme=http"
        return f"az://{container}/{name}?{options}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    state: BlobService

    def log_message(self, *_: Any) -> None:
        """Print nothing."""

    def handle_request(self) -> None:
        state, url = self.state, urlsplit(self.path)
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        query = {name: values[0] for name, values in parse_qs(url.query).items()}
        _, _, container, *names = unquote(url.path).split("/")
        name = "/".join(names)
        state.requests.append(f"{self.command} {name or query.get('comp')}")
        time.sleep(state.delay_s)
        if state.failures:
            self.reply(state.failures.pop(0))
        elif not self.headers.get("Authorization", "").startswith(f"SharedKey {ACCOUNT}:"):
            self.reply(403)
        elif container != CONTAINER:
            self.reply(404, b"<Error><Code>ContainerNotFound</Code></Error>")
        elif query.get("comp") == "list":
            self.reply(200, self.listing(query.get("prefix", ""), query.get("delimiter")))
        elif query.get("comp") == "batch":
            self.delete(body)
        elif self.command == "PUT":
            self.put(name, query, body)
        elif name not in state.blobs:
            self.reply(404, b"<Error><Code>BlobNotFound</Code></Error>")
        else:
            self.send_range(state.blobs[name])

    do_GET = do_HEAD = do_PUT = do_POST = handle_request  # noqa: N815 - names of the base class

    def put(self, name: str, query: dict[str, str], body: bytes) -> None:
        state = self.state
        if query.get("comp") == "block":
            state.blocks[query["blockid"]] = body
        elif query.get("comp") == "blocklist":
            blocks = re.findall(r"<(?:Uncommitted|Latest)>(.*?)</", body.decode())
            state.blobs[name] = b"".join(state.blocks[block] for block in blocks)
        else:
            state.blobs[name] = body
        self.reply(201)

    def delete(self, batch: bytes) -> None:
        """Remove the blobs of a batch, the only kind of deletion that the client sends."""
        parts = ""
        for number, name in enumerate(re.findall(rf"DELETE \S*/{CONTAINER}/(\S+)", batch.decode())):
            status = "404 Not Found" if self.state.blobs.pop(unquote(name), None) is None else "202 Accepted"
            parts += f"--part\r\nContent-Type: application/http\r\nContent-ID: {number}\r\n\r\nHTTP/1.1 {status}\r\n\r\n\r\n"
        self.reply(202, f"{parts}--part--\r\n".encode(), content_type="multipart/mixed; boundary=part")

    def listing(self, prefix: str, delimiter: str | None) -> bytes:
        entries: dict[str, str] = {}
        for name, content in sorted(self.state.blobs.items()):
            rest = name.removeprefix(prefix)
            if not name.startswith(prefix):
                continue
            if delimiter and delimiter in rest:
                folder = escape(prefix + rest.partition(delimiter)[0] + delimiter)
                entries[folder] = f"<BlobPrefix><Name>{folder}</Name></BlobPrefix>"
            else:
                entries[name] = (
                    f"<Blob><Name>{escape(name)}</Name><Properties><Last-Modified>{formatdate(0, usegmt=True)}"
                    f"</Last-Modified><Content-Length>{len(content)}</Content-Length><Etag>{tag(content)}</Etag>"
                    "<Content-Type>text/plain</Content-Type></Properties></Blob>"
                )
        blobs = "".join(entries.values())
        return f"<EnumerationResults><Blobs>{blobs}</Blobs><NextMarker/></EnumerationResults>".encode()

    def send_range(self, content: bytes) -> None:
        byte_range = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if byte_range is None:
            self.reply(200, content, tag=tag(content))
            return
        start, stop = int(byte_range[1]), min(int(byte_range[2]) + 1, len(content))
        content_range = f"bytes {start}-{stop - 1}/{len(content)}"
        self.reply(206, content[start:stop], tag=tag(content), content_range=content_range)

    def reply(
        self,
        status: int,
        body: bytes = b"",
        *,
        tag: str = "",
        content_range: str = "",
        content_type: str = "text/plain",
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Last-Modified", formatdate(0, usegmt=True))
        self.send_header("ETag", tag or "none")
        self.send_header("Content-Type", content_type)
        if content_range:
            self.send_header("Content-Range", content_range)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)


def tag(content: bytes) -> str:
    """Return the ETag of a blob."""
    return sha256(content).hexdigest()[:16]


@contextmanager
def blob_service() -> Iterator[BlobService]:
    """Run a service in a thread."""
    with serving(_Handler, BlobService()) as state:
        yield state
