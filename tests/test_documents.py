"""The pages of docs/ hold: links lead somewhere, options exist, and what can be run here is run as it is written."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.job.config import ROSInjectionConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
INGEST: Any = get_command(command_line())
ELSEWHERE = ("--executor", "--otel", "--metrics", "serve", "replay", "lint .")
"""What needs a cluster, a collector, a folder of the system, a client or rejected messages; and what reads every file there is."""
EXIT_CODES = {"ingest diff job.yaml other.yaml": 1}


def label(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(text: str) -> set[str]:
    """Return what the headings of a page are called in a link."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def shown(page: Path) -> list[str]:
    """Return the commands of the page's console blocks, without their comments."""
    blocks = re.findall(r"```console\n(.*?)```", TEXT[page], re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [re.sub(r"\s+# .*", "", line[2:]) for line in lines if line.startswith("$ ingest ")]


def mentioned(page: Path) -> Iterator[str]:
    """Yield the commands of the page, those within its sentences too."""
    yield from shown(page)
    yield from re.findall(r"`(ingest [^`|…]+)`", TEXT[page])


def prose(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", TEXT[page], re.DOTALL)


def manifest_keys() -> set[str]:
    """Return every key of a manifest, as `bag.path`, from the page that is made of its model."""
    sections = TEXT[ROOT / "docs" / "manifest.md"].split("\n## ")[1:]
    tables = {section.splitlines()[0].strip("`"): section for section in sections}
    return {
        f"{title}.{key}".removeprefix("The manifest.")
        for title, table in tables.items()
        for key in re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    }


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_every_link_leads_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", TEXT[page], flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\((?!https?://)([^)#\s]*)#?([^)\s]*)\)", text):
        goal = (page.parent / target).resolve() if target else page
        assert goal.exists(), target
        assert not anchor or anchor in anchors(goal.read_text(encoding="utf-8")), f"{target}#{anchor}"


def test_every_page_is_in_the_list_of_pages() -> None:
    listed = set(re.findall(r"\]\(([\w-]+\.md)", TEXT[ROOT / "docs" / "README.md"]))
    assert listed == {page.name for page in DOCS} - {"README.md"}


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_every_option_that_is_shown_exists(page: Path) -> None:
    for line in mentioned(page):
        words = shlex.split(line)[1:]
        command, options = INGEST, list(INGEST.params)
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
            options = list(command.params)
        if command is INGEST and words and words[0].endswith(".yaml"):
            options = list(INGEST.commands["run"].params)
        known = {name for option in options for name in option.opts} | {"--help", "-h"}
        assert {word for word in words if re.fullmatch(r"--?[a-z][\w-]*", word)} <= known, line


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with what the pages speak of: the quickstart, a recording, a job, and a sequence of it."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", tmp_path)
    run("-m", "mosaico_ingest", "run", "configs/quickstart.yaml", "-q", cwd=tmp_path)
    return tmp_path


def run(*arguments: str, cwd: Path, code: int = 0) -> str:
    done = subprocess.run(  # noqa: S603 - what the page says
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == code, f"{arguments}: {done.stderr}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in DOCS if shown(page)], ids=label)
def test_the_commands_run_one_after_the_other(project: Path, page: Path) -> None:
    job = "version: 1\nbag: {path: drive.mcap}\nsequence: {name: drive, if_exists: replace}\n"
    (project / "job.yaml").write_text(job)
    (project / "other.yaml").write_text(f"{job}topics: [/imu]\n")
    if page.name == "plan.md":
        (project / "job.yaml").unlink()  # made by its first command
    else:
        run("-m", "mosaico_ingest", "run", "job.yaml", "-q", cwd=project)
    for line in shown(page):
        if not any(word in line for word in ELSEWHERE):
            if " plan " in line:  # what would happen, before it has
                shutil.rmtree(project / "mosaico", ignore_errors=True)
            words = shlex.split(line.split(" > ")[0])[1:]
            run("-m", "mosaico_ingest", *words, cwd=project, code=EXIT_CODES.get(line, 0))


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in DOCS if prose(page)], ids=label)
def test_the_programs_run_one_after_the_other(project: Path, page: Path) -> None:
    run("-c", "\n".join(prose(page)), cwd=project)


def test_the_page_for_movers_names_every_setting_as_it_is_called() -> None:
    text = TEXT[ROOT / "docs" / "migration.md"]
    table = text.split("<!-- options -->")[1].split("<!-- end of options -->")[0]
    rows = [
        [re.findall(r"`([^`]+)`", cell) for cell in line.split("|")[1:5]] for line in table.splitlines()[4:-1]
    ]
    assert len(rows) > 10
    named = {name for _, config, _, _ in rows for name in config}
    assert named <= {field.name for field in fields(ROSInjectionConfig)}
    bag = {name for option in INGEST.commands["bag"].params for name in (*option.opts, option.envvar)}
    assert {name for _, _, options, _ in rows for name in options if name != "BAG"} <= bag
    assert {
        name for *_, manifest in rows for name in manifest if not name.startswith("ingest ")
    } <= manifest_keys()
