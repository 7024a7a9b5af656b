"""`ingest browse` serves the list and the pages of a store to this machine only, whatever the request contains."""

from __future__ import annotations

import http.client
import os
import re
import threading
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from run_reports import Outline, recording, run
from stored_sequences import NASTY, T0, TEXT, write_sequence

from mosaico_ingest.destinations.store import Store
from mosaico_ingest.errors import SinkError
from mosaico_ingest.pages.browser import PAGE_SIZE, BrowserServer, StoreBrowser, name_glob
from mosaico_ingest.report.events import RunStatus
from mosaico_ingest.report.run import report_text


@pytest.fixture(scope="module")
def server(store: Store) -> Iterator[BrowserServer]:
    running = BrowserServer(str(store.path))
    thread = threading.Thread(target=running.serve_forever)
    thread.start()
    yield running
    running.shutdown()
    thread.join()
    running.close()


def request(
    server: BrowserServer, path: str, *, method: str = "GET", host: str | None = None
) -> tuple[int, dict[str, str], str]:
    port = int(server.address.rstrip("/").rpartition(":")[2])
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or f"127.0.0.1:{port}")
    connection.endheaders()
    response = connection.getresponse()
    body = response.read().decode()
    connection.close()
    return response.status, dict(response.getheaders()), body


def test_browse_lists_sequences_with_links_to_their_pages(server: BrowserServer) -> None:
    status, headers, body = request(server, "/")
    assert status == 200
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    links = [link for link in Outline(body).links if link.startswith("/sequence/")]
    assert links == ["/sequence/hostile", "/sequence/quickstart_drive"]
    for link in links:
        assert request(server, link)[0] == 200


def test_browse_search_selects_by_name_and_metadata(server: BrowserServer) -> None:
    for query in ("QUICK", "q*drive", "vehicle=demo-01", "quick vehicle=demo-01"):
        body = request(server, f"/?q={quote(query)}")[2]
        assert "/sequence/quickstart_drive" in body
        assert "/sequence/hostile" not in body
    assert "No sequence matches" in request(server, "/?q=zzz")[2]


def test_browse_search_text_is_escaped(server: BrowserServer) -> None:
    body = request(server, f"/?q={quote('<script>x</script>')}")[2]
    assert "<script>x" not in body
    assert 'value="&lt;script&gt;x&lt;/script&gt;"' in body


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:80", ""]
)
def test_browse_request_for_another_host_is_refused(server: BrowserServer, host: str) -> None:
    status, _, body = request(server, "/", host=host or " ")
    assert status == 421
    assert "quickstart_drive" not in body


def test_browse_localhost_is_accepted(server: BrowserServer) -> None:
    port = server.address.rstrip("/").rpartition(":")[2]
    assert request(server, "/", host=f"localhost:{port}")[0] == 200


@pytest.mark.parametrize(
    "path",
    [
        "/sequence/..%2f..%2fetc%2fpasswd",
        "/sequence/../catalog.sqlite",
        "/catalog.sqlite",
        "/sequence/",
        "/sequence/%00",
        "/sequence/%ff",
        "/run/..%2f..%2fetc%2fpasswd",
        "/run/",
        "//etc/passwd",
    ],
)
def test_browse_unknown_address_is_not_found(server: BrowserServer, path: str) -> None:
    status, _, body = request(server, path)
    assert status == 404
    assert "SQLite" not in body
    assert "root:" not in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_browse_other_methods_are_not_implemented(server: BrowserServer, method: str) -> None:
    assert request(server, "/", method=method)[0] == 501


def test_browse_head_has_no_body(server: BrowserServer) -> None:
    status, headers, body = request(server, "/", method="HEAD")
    assert (status, body) == (200, "")
    assert int(headers["Content-Length"]) > 1000


def test_browse_listens_on_loopback_only(server: BrowserServer) -> None:
    assert server.address.startswith("http://127.0.0.1:")


def test_browse_pages_of_many_sequences_are_reached_by_links(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store")
    names = [f"drive_{at:04}" for at in range(2 * PAGE_SIZE + 7)]
    for name in names:
        store.create_sequence(name, {})
    browser = StoreBrowser(str(store.path))
    actual: list[str] = []
    address = "/?q=drive"
    while address:
        page = browser.page(address).html
        actual += re.findall(r'href="/sequence/(\w+)"', page)
        following = re.search(r'href="([^"]+)">Next page', page)
        address = unescape(following[1]) if following else ""
    assert actual == names


def test_browse_page_is_computed_again_after_the_sequence_changed(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store")
    row = {"timestamp_ns": T0, "data": "x"}
    write_sequence(store, "drive", {"/a": (TEXT, [row])})
    browser = StoreBrowser(str(store.path))
    first = browser.page("/sequence/drive").html
    assert browser.page("/sequence/drive").html is first
    store.add_note("drive", "the brake was defective")
    assert "the brake was defective" in browser.page("/sequence/drive").html


@pytest.fixture
def runs(tmp_path: Path) -> StoreBrowser:
    """The pages of an empty store with a failed run of Monday, a run of Tuesday, and a damaged file."""
    store = Store.open(tmp_path / "store")
    folder = tmp_path / "store" / "runs"
    folder.mkdir()
    reports = {"monday": run(recording(1, RunStatus.FAILED)), "tuesday": run(recording(2), recording(3))}
    for at, (name, report) in enumerate(reports.items()):
        file = folder / f"{name}.json"
        file.write_text(report.model_dump_json())
        os.utime(file, ns=(at, at))
    (folder / "damaged.json").write_text(NASTY)
    return StoreBrowser(str(store.path))


def test_browse_lists_runs_newest_first_with_their_pages_and_sequences(runs: StoreBrowser) -> None:
    html = runs.page("/runs").html
    links = Outline(html).links
    assert [link for link in links if link.startswith("/run/")] == ["/run/tuesday.json", "/run/monday.json"]
    assert f"/sequence/{recording(3).sequence}" in links
    assert "The run failed" in html
    assert "damaged.json: is not a report" in html
    assert NASTY not in html
    page = runs.page("/run/monday.json")
    assert page.status == 200
    assert "The run failed" in page.html
    assert "/runs" in Outline(page.html).links


def test_browse_search_selects_runs_by_sequence(runs: StoreBrowser) -> None:
    links = Outline(runs.page(f"/runs?q={recording(1).sequence.upper()}").html).links
    assert [link for link in links if link.startswith("/run/")] == ["/run/monday.json"]


def test_browse_run_is_read_again_after_its_report_changed(runs: StoreBrowser, tmp_path: Path) -> None:
    first = runs.page("/run/monday.json").html
    assert runs.page("/run/monday.json").html is first
    file = tmp_path / "store" / "runs" / "monday.json"
    file.write_text(run(recording(1)).model_dump_json())
    assert "Everything was stored" in runs.page("/run/monday.json").html
    assert "The run failed" not in runs.page("/runs").html


def test_browse_damaged_report_states_the_reason(runs: StoreBrowser) -> None:
    page = runs.page("/run/damaged.json")
    assert page.status == 503
    assert "is not a report" in page.html


def test_browse_lists_runs_of_another_folder(store: Store, tmp_path: Path) -> None:
    file = tmp_path / "night.jsonl"
    file.write_text("".join(report_text(run(recording(1)), file)))
    assert "/run/night.jsonl" in Outline(StoreBrowser(str(store.path), tmp_path).page("/runs").html).links


def test_browse_missing_store_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SinkError):
        BrowserServer(str(tmp_path / "nothing"))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(address=st.text(max_size=40).map(lambda text: f"/{text}"))
def test_browse_any_address_has_a_page(store: Store, address: str) -> None:
    page = StoreBrowser(str(store.path)).page(address)
    assert page.status in {200, 404}
    assert page.html.startswith("<!doctype html>")


@given(st.text(max_size=20), st.text(max_size=5), st.text(max_size=5))
def test_name_glob_matches_names_that_contain_the_text(text: str, before: str, after: str) -> None:
    from fnmatch import fnmatchcase  # noqa: PLC0415 - only this test needs it

    if "*" not in text and "?" not in text:
        assert fnmatchcase(f"{before}{text}{after}", name_glob(text))
        if len(text.swapcase()) == len(text) and text.isascii():
            assert fnmatchcase(f"{before}{text.swapcase()}{after}", name_glob(text))
