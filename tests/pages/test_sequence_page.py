"""The page of a stored sequence: complete, escaped, self-contained, and usable although topics are damaged."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from run_reports import Outline, unpacked
from stored_sequences import NASTY, NUMBERS, T0, TEXT, write_sequence
from typer.testing import CliRunner

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.destinations.store import Store
from mosaico_ingest.pages.sequence import sequence_page, sequence_snippets


@pytest.fixture(scope="module")
def quickstart_page(store: Store) -> str:
    return sequence_page(store, "quickstart_drive")


def sections(page: str) -> set[str]:
    return set(Outline(page).ids)


@pytest.mark.parametrize("name", ["quickstart_drive", "hostile"])
def test_sequence_page_is_well_formed_and_self_contained(store: Store, name: str) -> None:
    page = sequence_page(store, name)
    outline = Outline(page)
    assert outline.open == []
    assert len(outline.ids) == len(set(outline.ids))
    assert all(source.startswith("data:image/") for source in outline.loads)
    assert {link for link in outline.links if not link.startswith("#")} == set()
    assert {link[1:] for link in outline.links} <= set(outline.ids)


def test_sequence_page_of_quickstart_has_every_section(quickstart_page: str) -> None:
    expected = {"topics", "cameras", "tracks", "clouds", "plots", "frames", "schema", "metadata", "code"}
    assert expected <= sections(quickstart_page)
    assert quickstart_page.count("data:image/jpeg;base64,") == 12
    assert quickstart_page.count("data:image/png;base64,") == 4
    assert "10 m by 10 m (along x by along y)" in quickstart_page
    assert "base_link" in quickstart_page
    assert "668745d8b02f64e7a935b4245325448d" in quickstart_page


def test_sequence_page_has_units_and_statistics_of_each_column(quickstart_page: str) -> None:
    start = quickstart_page.index('<th scope="row">acceleration.z</th>')
    row = quickstart_page[start : quickstart_page.index("</tr>", start)]
    assert "m/s²" in row
    assert "9.8" in row


def test_sequence_page_plots_related_fields_together(quickstart_page: str) -> None:
    data = re.findall(r'\{"unit":.*?\]\}\]\}', unpacked(quickstart_page))
    plots = [re.findall('"name":"([^"]+)"', plot) for plot in data]
    assert ["x", "y"] in plots
    assert ["[0]", "[1]"] in plots
    assert ["voltage"] in plots
    assert quickstart_page.count("<h3>acceleration (m/s²)</h3>") == 1


def test_sequence_page_hostile_texts_are_escaped_and_control_characters_visible(store: Store) -> None:
    page = sequence_page(store, "hostile")
    assert not {"\x1b", "\u202e"} & set(page)
    assert "<script>document.title" not in unpacked(page)
    assert "\\x1b[2J\\u202e" in page
    assert NASTY.encode("unicode_escape").decode().count("\\u202e") == 1


def test_sequence_page_states_why_an_image_is_not_shown(store: Store) -> None:
    page = sequence_page(store, "hostile")
    assert "Not shown: " in page
    assert "6e 6f 20 69 6d 61 67 65" in page


def test_sequence_page_damaged_file_is_a_problem_and_other_topics_are_shown(
    store: Store, tmp_path: Path
) -> None:
    shutil.copytree(str(store.path), tmp_path / "damaged")
    damaged = Store.open(tmp_path / "damaged", create=False)
    (path,) = damaged.paths("quickstart_drive", "/imu")
    Path(str(path)).write_bytes(b"PAR1 damaged")
    page = sequence_page(damaged, "quickstart_drive")
    assert "Some content cannot be shown" in page
    assert "/imu: " in page
    assert "10 m by 10 m" in page


def test_sequence_page_empty_sequence_has_no_empty_sections(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store")
    store.create_sequence("empty", {})
    page_sections = sections(sequence_page(store, "empty"))
    assert "topics" in page_sections
    assert not {"cameras", "tracks", "plots", "frames", "logs", "code"} & page_sections


def test_snippets_run_and_print_rows(store: Store) -> None:
    snippets = {one.title: one.code for one in sequence_snippets(store, store.sequence("quickstart_drive"))}
    assert {"DuckDB", "Polars", "Python"} < set(snippets)
    for title in ("DuckDB", "Polars", "Python"):
        result = subprocess.run(  # noqa: S603 - a program of ours
            [sys.executable, "-c", snippets[title]], capture_output=True, text=True, check=False
        )
        assert result.returncode == 0, f"{title}: {result.stderr}"
        assert "acceleration" in result.stdout or '"x"' in result.stdout or "x" in result.stdout


def test_snippets_select_a_topic_with_numbers_and_a_column_beside_the_time(tmp_path: Path) -> None:
    store = Store.open(tmp_path / "store")
    numbers = [{"timestamp_ns": T0, "value": 1.0, "constant": 7, "wheels": []}]
    texts = [{"timestamp_ns": T0 + at, "data": "x"} for at in range(5)]
    write_sequence(store, "drive", {"/text": (TEXT, texts), "/numbers": (NUMBERS, numbers)})
    write_sequence(store, "texts", {"/text": (TEXT, texts)})
    code = {name: sequence_snippets(store, store.sequence(name))[0].code for name in ("drive", "texts")}
    assert 'SELECT timestamp_ns, "value" FROM' in code["drive"]
    assert 'SELECT timestamp_ns, "data" FROM' in code["texts"]


def test_snippets_quote_names(tmp_path: Path) -> None:

    store = Store.open(tmp_path / "it's here")
    write_sequence(store, "drive", {"/a": (TEXT, [{"timestamp_ns": T0, "data": "x"}])})
    for snippet in sequence_snippets(store, store.sequence("drive")):
        if snippet.title in {"DuckDB", "Polars", "Python"}:
            result = subprocess.run(  # noqa: S603 - a program of ours
                [sys.executable, "-c", snippet.code], capture_output=True, text=True, check=False
            )
            assert result.returncode == 0, f"{snippet.title}: {result.stderr}"


def test_store_page_command_writes_file_named_after_the_sequence(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(
        command_line(), ["store", "page", "quickstart_drive", "--store", str(store.path)]
    )
    assert result.exit_code == 0, result.output
    assert "<title>quickstart_drive</title>" in Path("quickstart_drive.html").read_text()
