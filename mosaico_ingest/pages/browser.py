"""Local web server of the pages of sequences and runs, and the folder of its reports.

The server listens on the loopback address only. It accepts requests whose `Host` is that address, so that a web site cannot
read the store through a name of its own (DNS rebinding). Names are looked up in the catalog and are never used as paths.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from datetime import datetime
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, quote, unquote, urlsplit

from msgspec import Struct

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import IngestError
from mosaico_ingest.findings import one_line
from mosaico_ingest.pages.design import render
from mosaico_ingest.pages.run import Verdict, run_page, verdict_of
from mosaico_ingest.pages.sequence import sequence_page
from mosaico_ingest.report.run import LINES_SUFFIX, read_report
from mosaico_ingest.version import __version__

MAX_RUNS = 200
"""Number of report files that are listed, the newest first."""
Signature = tuple[int, int]
"""Time of the last change in ns and size of a file."""
HOST = "127.0.0.1"
PAGE_SIZE = 50
"""Sequences on one page of the list."""
CACHED_PAGES = 16
"""Pages that are kept until their sequence or report changes."""
SEQUENCE = "/sequence/"
"""The start of the addresses of sequences."""
RUNS = "/runs"
"""The address of the list of runs."""
RUN = "/run/"
"""The start of the addresses of runs."""
RUNS_FOLDER = "runs"
"""The folder in a store whose report files are listed if no other folder is given."""
SHOWN_SEQUENCES = 3
"""Sequences that the list of runs names for each run."""
TIMEOUT_S = 30
"""Seconds after which an idle connection is closed."""
HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class RunSummary(Struct, frozen=True):
    """One report file in the list."""

    name: str
    """The name of the file."""
    started_at: datetime | None = None
    verdict: Verdict | None = None
    written: int = 0
    """Number of written messages."""
    sequences: tuple[str, ...] = ()
    problem: str | None = None
    """The reason why the file cannot be read."""


class ReportFolder:
    """The files `*.json` and `*.jsonl` of a folder; a file is read again only if it changes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._summaries: dict[str, tuple[Signature, RunSummary]] = {}

    def find(self, name: str) -> tuple[Path, Signature] | None:
        """Return a file of the folder by its name, which may come from anyone, with its signature."""
        return next(((path, signature) for path, signature in self._files() if path.name == name), None)

    def summaries(self, text: str = "") -> list[RunSummary]:
        """Return the newest runs whose name, or the name of one of their sequences, contains a text."""
        summaries = {
            path.name: self._summary(path, signature) for path, signature in self._files()[:MAX_RUNS]
        }
        needle = text.casefold()
        return [
            each
            for each in summaries.values()
            if any(needle in name.casefold() for name in (each.name, *each.sequences))
        ]

    def _files(self) -> list[tuple[Path, Signature]]:
        """Return the files, the newest first."""
        files: list[tuple[Path, Signature]] = []
        for path in (*self.path.glob("*.json"), *self.path.glob(f"*{LINES_SUFFIX}")):
            try:
                state = path.stat()
            except OSError:  # deleted since it was listed
                continue
            files.append((path, (state.st_mtime_ns, state.st_size)))
        return sorted(files, key=lambda file: file[1], reverse=True)

    def _summary(self, path: Path, signature: Signature) -> RunSummary:
        cached = self._summaries.get(path.name)
        if cached is None or cached[0] != signature:
            cached = self._summaries[path.name] = (signature, _summary(path))
        return cached[1]


class Page(Struct, frozen=True):
    """A response."""

    status: HTTPStatus
    html: str


class StoreBrowser:
    """The pages of one store by address; can be used by several threads."""

    def __init__(self, location: str, runs: Path | None = None) -> None:
        """Open the store; `runs` is the folder of report files, which defaults to `runs` in the folder of the store.

        Raises:
            SinkError: The store does not exist.
        """
        Store.open(location, create=False)
        self._location = location
        self._reports = ReportFolder(runs or Path(location) / RUNS_FOLDER)
        self._pages: OrderedDict[str, tuple[object, str]] = OrderedDict()
        self._lock = threading.Lock()

    def page(self, address: str) -> Page:
        """Return the page of an address, which may come from anyone."""
        parts = urlsplit(address)
        try:
            if parts.path == "/":
                return Page(HTTPStatus.OK, self._list(parts.query))
            if parts.path.startswith(SEQUENCE):
                return self._sequence(unquote(parts.path.removeprefix(SEQUENCE)))
            if parts.path == RUNS:
                return Page(HTTPStatus.OK, self._runs(parts.query))
            if parts.path.startswith(RUN):
                return self._run(unquote(parts.path.removeprefix(RUN)))
        except IngestError as error:
            return _problem(HTTPStatus.SERVICE_UNAVAILABLE, "The content cannot be read", str(error))
        return _problem(HTTPStatus.NOT_FOUND, "There is no such page", one_line(parts.path))

    def _list(self, query: str) -> str:
        values = {name: texts[-1] for name, texts in parse_qs(query).items()}
        words = values.get("q", "").split()
        metadata = dict(word.split("=", 1) for word in words if "=" in word)
        text = " ".join(word for word in words if "=" not in word)
        incomplete = "incomplete" in values
        listing = Store.open(self._location, create=False).listing(
            match=name_glob(text) if text else None,
            metadata=metadata,
            incomplete=incomplete,
            after=values.get("after"),
            limit=PAGE_SIZE,
        )
        parameters = f"q={quote(values.get('q', ''))}{'&incomplete=on' if incomplete else ''}"
        return render(
            "browse.html",
            store=self._location,
            listing=listing,
            query=values.get("q", ""),
            incomplete=incomplete,
            is_first="after" not in values,
            first_link=f"/?{parameters}",
            next_link=f"/?{parameters}&after={quote(listing.next_after)}" if listing.next_after else None,
            links={each.name: sequence_link(each.name) for each in listing.sequences},
            runs_link=RUNS,
            version=__version__,
        )

    def _sequence(self, name: str) -> Page:
        store = Store.open(self._location, create=False)
        info = store.find_sequence(name)
        if info is None:
            return _problem(HTTPStatus.NOT_FOUND, "There is no such sequence", name)
        html = self._cached(
            sequence_link(name),
            info,
            lambda: sequence_page(store, name, list_link="/", runs_link=f"{RUNS}?q={quote(name)}"),
        )
        return Page(HTTPStatus.OK, html)

    def _runs(self, query: str) -> str:
        text = parse_qs(query).get("q", [""])[-1]
        with self._lock:
            runs = self._reports.summaries(text)
        names = {name for run in runs for name in run.sequences[:SHOWN_SEQUENCES]}
        return render(
            "runs.html",
            store=self._location,
            folder=str(self._reports.path),
            action=RUNS,
            query=text,
            runs=runs,
            links={run.name: f"{RUN}{quote(run.name, safe='')}" for run in runs},
            sequence_links={name: sequence_link(name) for name in names},
            shown=SHOWN_SEQUENCES,
            version=__version__,
        )

    def _run(self, name: str) -> Page:
        file = self._reports.find(name)
        if file is None:
            return _problem(HTTPStatus.NOT_FOUND, "There is no such run", name)
        path, signature = file
        html = self._cached(f"{RUN}{name}", signature, lambda: run_page(read_report(path), list_link=RUNS))
        return Page(HTTPStatus.OK, html)

    def _cached(self, address: str, state: object, make: Callable[[], str]) -> str:
        """Return the page of an address, which is computed again only if its state changes."""
        with self._lock:  # pages are expensive, so two requests do not compute the same one
            page = self._pages.get(address)
            if page is None or page[0] != state:
                page = self._pages[address] = (state, make())
            self._pages.move_to_end(address)
            while len(self._pages) > CACHED_PAGES:
                self._pages.popitem(last=False)
        return page[1]


def sequence_link(name: str) -> str:
    """Return the address of the page of a sequence."""
    return f"{SEQUENCE}{quote(name, safe='')}"


def name_glob(text: str) -> str:
    """Return the glob for names that contain a text, in upper or lower case; a text with `*` or `?` is a glob itself."""
    if "*" in text or "?" in text:
        return text
    return f"*{''.join(_either_case(character) for character in text)}*"


class BrowserServer:
    """The web server of a store; `serve_forever` returns after `close`."""

    def __init__(self, location: str, port: int = 0, *, runs: Path | None = None) -> None:
        """Listen on the loopback address.

        Raises:
            SinkError: The store does not exist.
            OSError: The port is in use.
        """
        browser = StoreBrowser(location, runs)

        class Handler(_Handler):
            pages = browser

        self._server = _Server((HOST, port), Handler)

    @property
    def address(self) -> str:
        """The address of the list."""
        return f"http://{HOST}:{self._server.server_address[1]}/"

    def serve_forever(self) -> None:
        """Answer requests."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop the server, which must be answering requests in another thread, or not at all."""
        self._server.server_close()

    def shutdown(self) -> None:
        """Let `serve_forever` return; it must run in another thread."""
        self._server.shutdown()


def _summary(path: Path) -> RunSummary:
    try:
        report = read_report(path)
    except IngestError as error:
        return RunSummary(path.name, problem=str(error))
    return RunSummary(
        path.name,
        report.summary.started_at,
        verdict_of(report.recordings),
        report.summary.written,
        tuple(dict.fromkeys(each.sequence for each in report.recordings)),
    )


def _either_case(character: str) -> str:
    if character == "[":
        return "[[]"
    lower, upper = character.lower(), character.upper()
    return f"[{lower}{upper}]" if lower != upper and len(lower) == len(upper) == 1 else character


def _problem(status: HTTPStatus, title: str, text: str) -> Page:
    return Page(status, render("problem.html", title=title, text=text))


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True


class _Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD; other methods are not implemented."""

    pages: StoreBrowser
    protocol_version = "HTTP/1.1"
    server_version = "mosaico-ingest"
    sys_version = ""
    timeout = TIMEOUT_S

    def do_GET(self) -> None:
        """Answer a request with its page."""
        self._answer(has_body=True)

    def do_HEAD(self) -> None:
        """Answer a request with the headers of its page."""
        self._answer(has_body=False)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002, ANN401 - the signature of the base class
        """Print nothing: requests contain text of other programs."""

    def _answer(self, *, has_body: bool) -> None:
        if self._is_own_host(self.headers.get_all("Host") or []):
            page = self.pages.page(self.path)
        else:
            text = f"Open {self._own_address()} instead."
            page = _problem(HTTPStatus.MISDIRECTED_REQUEST, "This server has another address", text)
        body = page.html.encode()
        self.send_response(page.status)
        for name, value in {**HEADERS, "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        if has_body:
            self.wfile.write(body)

    def _own_address(self) -> str:
        return f"http://{HOST}:{self._port}/"

    @property
    def _port(self) -> int:
        address: Any = self.server.server_address
        return int(address[1])

    def _is_own_host(self, hosts: list[str]) -> bool:
        """Return whether the request names this server by a loopback address."""
        return len(hosts) == 1 and hosts[0].lower() in {f"{HOST}:{self._port}", f"localhost:{self._port}"}
