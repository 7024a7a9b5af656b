"""A minimal S3 service with one bucket in memory and conditional writes; `python bucket_service.py` prints its port.

It is much faster than moto, so that a catalog of 100,000 sequences can be measured. A GET of `/-/counts` returns the number of
requests by method, the bytes received and sent since the last such request.
"""

from __future__ import annotations

import json
import re
import sys
import threading
from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from email.utils import format_datetime
from hashlib import md5
from http.server import BaseHTTPRequestHandler
from io import BytesIO
from typing import IO, Any
from urllib.parse import parse_qs, quote, unquote, urlsplit
from xml.sax.saxutils import escape, unescape

from web_server import serving

BUCKET = "bucket"
CONTROL = "/-/counts"
PAGE = 1000


@dataclass(frozen=True)
class Stored:
    """An object."""

    content: bytes
    time: datetime
    tag: str


@dataclass
class BucketService:
    """The state of a running service."""

    port: int = 0
    objects: dict[str, Stored] = field(default_factory=dict[str, Stored])
    keys: list[str] = field(default_factory=list[str])
    """The sorted keys of the objects."""
    parts: dict[str, dict[int, bytes]] = field(default_factory=dict[str, dict[int, bytes]])
    counts: Counter[str] = field(default_factory=Counter[str])
    requests: list[str] = field(default_factory=list[str])
    """Method and path of each request."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def url(self, key: str) -> str:
        """Return the URL of an object with the options for this service."""
        return f"s3://{BUCKET}/{key}?endpoint_override=127.0.0.1:{self.port}&scheme=http&region=us-east-1"

    def put(self, key: str, content: bytes) -> str:
        """Write an object and return its tag."""
        tag = f'"{md5(content, usedforsecurity=False).hexdigest()}"'
        if key not in self.objects:
            insort(self.keys, key)
        self.objects[key] = Stored(content, datetime.now(timezone.utc), tag)
        return tag

    def delete(self, key: str) -> None:
        if self.objects.pop(key, None) is not None:
            del self.keys[bisect_left(self.keys, key)]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    state: BucketService

    def log_message(self, *_: Any) -> None:
        """Print nothing."""

    def handle_request(self) -> None:
        url = urlsplit(self.path)
        if url.path == CONTROL:
            counts, self.state.counts = self.state.counts, Counter()
            self.reply(200, json.dumps(counts).encode())
            return
        query = {name: values[0] for name, values in parse_qs(url.query, keep_blank_values=True).items()}
        body = self.body()
        key = unquote(url.path).partition(f"/{BUCKET}")[2].lstrip("/")
        with self.state.lock:
            self.state.requests.append(f"{self.command} {url.path}")
            kind = "LIST" if self.command == "GET" and not key else self.command
            self.state.counts.update({kind: 1, "received": len(body)})
            self.answer(key, query, body)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = handle_request  # noqa: N815 - names of the base class

    def answer(self, key: str, query: dict[str, str], body: bytes) -> None:
        if not key and self.command == "GET":
            self.reply(200, self.listing(query))
        elif not key and "delete" in query:
            for name in re.findall(r"<Key>(.*?)</Key>", body.decode()):
                self.state.delete(unescape(name, {"&quot;": '"', "&apos;": "'"}))
            self.reply(200, b"<DeleteResult/>")
        elif not key:
            self.reply(200)
        elif self.command in {"GET", "HEAD"}:
            self.send_object(key)
        elif self.command == "DELETE":
            self.state.delete(key)
            self.reply(204)
        elif "uploadId" in query or "uploads" in query:
            self.upload(key, query, body)
        else:
            self.put(key, body)

    def put(self, key: str, body: bytes) -> None:
        stored = self.state.objects.get(key)
        match, none_match = self.headers.get("If-Match"), self.headers.get("If-None-Match")
        if (none_match == "*" and stored) or (match and (stored is None or stored.tag != match)):
            self.reply(412, b"<Error><Code>PreconditionFailed</Code></Error>")
        else:
            self.reply(200, tag=self.state.put(key, body))

    def upload(self, key: str, query: dict[str, str], body: bytes) -> None:
        parts = self.state.parts
        if "uploads" in query:
            parts[key] = {}
            found = (
                f"<Bucket>{BUCKET}</Bucket><Key>{escape(key)}</Key><UploadId>{quote(key, safe='')}</UploadId>"
            )
            self.reply(
                200, f"<InitiateMultipartUploadResult>{found}</InitiateMultipartUploadResult>".encode()
            )
        elif self.command == "PUT":
            parts[key][int(query["partNumber"])] = body
            self.reply(200, tag='"part"')
        else:
            tag = self.state.put(key, b"".join(content for _, content in sorted(parts.pop(key).items())))
            content = f"<Key>{escape(key)}</Key><ETag>{escape(tag)}</ETag>"
            self.reply(
                200, f"<CompleteMultipartUploadResult>{content}</CompleteMultipartUploadResult>".encode()
            )

    def listing(self, query: dict[str, str]) -> bytes:
        prefix, delimiter = query.get("prefix", ""), query.get("delimiter", "")
        count, keys = int(query.get("max-keys", PAGE)), self.state.keys
        position = bisect_left(keys, query.get("continuation-token") or prefix)
        entries: dict[str, str] = {}
        while position < len(keys) and keys[position].startswith(prefix) and len(entries) < count:
            key = keys[position]
            inner = key[len(prefix) :].partition(delimiter)[0] if delimiter else key[len(prefix) :]
            if delimiter and prefix + inner != key:
                folder = prefix + inner + delimiter
                entries[folder] = f"<CommonPrefixes><Prefix>{escape(folder)}</Prefix></CommonPrefixes>"
                position = bisect_left(keys, folder[:-1] + chr(ord(delimiter) + 1))
                continue
            stored = self.state.objects[key]
            entries[key] = (
                f"<Contents><Key>{escape(key)}</Key><LastModified>{stored.time:%Y-%m-%dT%H:%M:%S.000Z}</LastModified>"
                f"<ETag>{escape(stored.tag)}</ETag><Size>{len(stored.content)}</Size></Contents>"
            )
            position += 1
        more = position < len(keys) and keys[position].startswith(prefix)
        token = f"<NextContinuationToken>{escape(keys[position])}</NextContinuationToken>" if more else ""
        return (
            f"<ListBucketResult><Name>{BUCKET}</Name><KeyCount>{len(entries)}</KeyCount><IsTruncated>{str(more).lower()}"
            f"</IsTruncated>{token}{''.join(entries.values())}</ListBucketResult>"
        ).encode()

    def send_object(self, key: str) -> None:
        stored = self.state.objects.get(key)
        if stored is None:
            self.reply(404, b"<Error><Code>NoSuchKey</Code></Error>")
            return
        content, byte_range = (
            stored.content,
            re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", "")),
        )
        if byte_range is None:
            self.reply(200, content, tag=stored.tag, time=stored.time)
            return
        start, end = int(byte_range[1]), int(byte_range[2] or len(content)) + 1
        location = f"bytes {start}-{min(end, len(content)) - 1}/{len(content)}"
        self.reply(206, content[start:end], tag=stored.tag, time=stored.time, location=location)

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            content = joined_chunks(self.rfile)
        else:
            content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        is_framed = "aws-chunked" in self.headers.get("Content-Encoding", "")
        return joined_chunks(BytesIO(content)) if is_framed else content

    def reply(
        self,
        status: int,
        body: bytes = b"",
        *,
        tag: str = "",
        time: datetime | None = None,
        location: str = "",
    ) -> None:
        self.state.counts["sent"] += 0 if self.command == "HEAD" else len(body)
        lines = {
            "Content-Length": str(len(body)),
            "Content-Type": "application/xml",
            "Last-Modified": format_datetime(time or datetime.now(timezone.utc), usegmt=True),
            "ETag": tag,
            "Content-Range": location,
        }
        self.send_response(status)
        for name, value in lines.items():
            if value and not (status == 204 and name == "Content-Length"):
                self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)


def joined_chunks(file: IO[bytes]) -> bytes:
    """Return the content of chunks that each have a size, a line end, the content and a line end."""
    chunks = list[bytes]()
    while size := int(file.readline().partition(b";")[0], 16):
        chunks.append(file.read(size))
        file.readline()
    while file.readline().strip():  # checksums
        pass
    return b"".join(chunks)


@contextmanager
def bucket_service() -> Iterator[BucketService]:
    """Run a service in a thread."""
    with serving(_Handler, BucketService()) as state:
        yield state


if __name__ == "__main__":
    with bucket_service() as service:
        sys.stdout.write(f"{service.port}\n")
        sys.stdout.flush()
        sys.stdin.read()
