"""The pages of docs/: links lead to existing targets, options exist, and commands and programs run as written."""

from __future__ import annotations

import json
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
import yaml
from documentation_site import CODE, LINK, build, navigation, readme_with_page_list, write_sources
from generated_files import generated_files
from typer.main import get_command

from mosaico_ingest.cli.app import command_line
from mosaico_ingest.job.config import ROSInjectionConfig

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = {page: page.read_text(encoding="utf-8") for page in PAGES}
INGEST: Any = get_command(command_line())
NOT_RUN = ("--executor", "--from", "--otel", "--metrics", "serve", "browse", "replay", "lint .", "s3://")
"""Parts of commands that need a cluster, a server, a collector, a system folder, a client or rejected messages, or that read all files."""
EXIT_CODES = {
    "ingest diff job.yaml other.yaml": 1,
    "ingest bag damaged.mcap --name recovered --report run.json": 4,
}


def label(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(text: str) -> set[str]:
    """Return the link anchors of the headings of a page."""
    without_code = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", without_code, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def console_commands(page: Path) -> list[str]:
    """Return the commands of the page's console blocks, without their comments."""
    blocks = re.findall(r"```console\n(.*?)```", TEXT[page], re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [re.sub(r"\s+# .*", "", line[2:]) for line in lines if line.startswith("$ ingest ")]


def all_commands(page: Path) -> Iterator[str]:
    """Yield the commands of the page, including those within sentences."""
    yield from console_commands(page)
    yield from re.findall(r"`(ingest [^`|…]+)`", TEXT[page])


def programs(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", TEXT[page], re.DOTALL)


def manifest_keys() -> set[str]:
    """Return every manifest key, such as `bag.path`, from the generated reference page."""
    sections = TEXT[ROOT / "docs" / "manifest.md"].split("\n## ")[1:]
    tables = {section.splitlines()[0].strip("`"): section for section in sections}
    return {
        f"{title}.{key}".removeprefix("The manifest.")
        for title, table in tables.items()
        for key in re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    }


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_link_leads_to_existing_file_and_heading(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", TEXT[page], flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\((?!https?://)([^)#\s]*)#?([^)\s]*)\)", text):
        goal = (page.parent / target).resolve() if target else page
        assert goal.exists(), target
        assert not anchor or anchor in anchors(goal.read_text(encoding="utf-8")), f"{target}#{anchor}"


def test_navigation_contains_every_page_once() -> None:
    pages = [path for section in navigation().values() for path in section.values()]
    assert len(pages) == len(set(pages))
    assert {*DOCS, ROOT / "docs" / "rules" / "README.md"} <= set(pages)
    assert [page for page in pages if not page.is_file()] == []


def test_docs_readme_has_the_page_list_of_the_navigation() -> None:
    assert TEXT[ROOT / "docs" / "README.md"] == readme_with_page_list(), "run ./dev docs"


@pytest.mark.parametrize("path", generated_files(), ids=lambda path: path.name)
def test_generated_file_equals_its_generator(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == generated_files()[path](), "run ./dev docs"


def all_leaf_commands(group: Any, path: str) -> Iterator[tuple[str, Any]]:
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from all_leaf_commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def test_command_line_page_names_every_option_of_every_command() -> None:
    sections = dict(
        section.split("\n", 1) for section in f"\n{TEXT[ROOT / 'docs' / 'cli.md']}".split("\n## ")[1:]
    )
    commands = dict(all_leaf_commands(INGEST, "ingest"))
    assert sections.keys() == commands.keys()
    for path, command in commands.items():
        for option in command.params:
            for name in option.opts if option.param_type_name == "option" else ():
                assert name == "--help" or re.search(rf"`{name}[ `]", sections[path]), f"{path} {name}"


def test_site_sources_contain_every_linked_file(tmp_path: Path) -> None:
    write_sources(tmp_path)
    for page in (tmp_path / "docs").rglob("*.md"):
        for link in LINK.finditer(CODE.sub("", page.read_text(encoding="utf-8"))):
            assert (page.parent / link[2]).is_file(), f"{page}: {link[2]}"


@pytest.mark.slow
def test_site_builds_in_strict_mode_and_loads_nothing_from_other_servers(tmp_path: Path) -> None:
    pytest.importorskip("zensical", reason="the extra docs is not installed")
    build(tmp_path / "sources", tmp_path / "site")
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(DOCS)
    for page in pages:
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?([^\" >]+)", text)
        loaded += re.findall(
            r"<link[^>]*rel=\"?(?:stylesheet|preload|preconnect|icon)[^>]*href=\"?([^\" >]+)", text
        )
        assert [url for url in loaded if url.startswith(("http:", "https:", "//"))] == []
    options = (tmp_path / "site" / "cli" / "index.html").read_text(encoding="utf-8")
    assert "<code>--executor local|ray</code>" in options
    signatures = (tmp_path / "site" / "python" / "index.html").read_text(encoding="utf-8")
    assert 'id="mosaico_ingest.ROSLoader"' in signatures


@pytest.mark.slow
def test_terminal_pictures_show_the_current_output(tmp_path: Path) -> None:
    pytest.importorskip("pty", reason="only POSIX systems have pseudo terminals")
    from terminal import picture_text  # noqa: PLC0415 - it imports pty
    from terminal_pictures import take_pictures  # noqa: PLC0415 - it imports pty

    for name, picture in take_pictures(tmp_path):
        stored = (ROOT / "docs" / "images" / f"{name}.svg").read_text(encoding="utf-8")
        assert picture_text(stored) == picture_text(picture), f"{name}: run ./dev screenshots"


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_option_in_command_exists(page: Path) -> None:
    for line in all_commands(page):
        words = shlex.split(line)[1:]
        command, options = INGEST, list(INGEST.params)
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
            options = list(command.params)
        if command is INGEST and words and words[0].endswith(".yaml"):
            options = list(INGEST.commands["run"].params)
        names = {name for option in options for name in option.opts} | {"--help", "-h"}
        assert {word for word in words if re.fullmatch(r"--?[a-z][\w-]*", word)} <= names, line


COMMANDS = """
import json, shutil, sys
from mosaico_ingest.cli.app import main

for words, code, is_plan in json.loads(sys.argv[1]):
    if is_plan:  # the plan of a job that has not run yet
        shutil.rmtree("mosaico", ignore_errors=True)
    try:
        main(words)
        exit_code = 0
    except SystemExit as error:
        exit_code = error.code or 0
    if exit_code != code:
        sys.exit(f"ingest {' '.join(words)}: exit code {exit_code}, expected {code}")
"""
"""A program that runs commands in one process, because starting Python takes most of the time of a short command."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with the files that the pages use: the quickstart and its sequence, and a recording."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    shutil.copy(ROOT / "configs" / "quickstart" / "drive.mcap", tmp_path)
    run("-m", "mosaico_ingest", "run", "configs/quickstart.yaml", "-q", cwd=tmp_path)
    return tmp_path


def run(*arguments: str, cwd: Path, code: int = 0) -> str:
    finished = subprocess.run(  # noqa: S603 - commands of the pages
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, check=False, timeout=120
    )
    assert finished.returncode == code, f"{arguments}: {finished.stderr}"
    return finished.stdout


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in DOCS if console_commands(page)], ids=label)
def test_commands_of_page_succeed_in_order(project: Path, page: Path) -> None:
    if page.name == "start.md":
        shutil.rmtree(project / "mosaico")  # its first command ingests the quickstart
    content = (project / "drive.mcap").read_bytes()
    (project / "damaged.mcap").write_bytes(content[: len(content) // 2])
    job = "version: 1\nbag: {path: drive.mcap}\nsequence: {name: drive, if_exists: replace}\n"
    (project / "job.yaml").write_text(job)
    (project / "other.yaml").write_text(f"{job}topics: [/imu]\n")
    if page.name == "plan.md":
        (project / "job.yaml").unlink()  # its first command writes it
    else:
        run("-m", "mosaico_ingest", "run", "job.yaml", "-q", cwd=project)
    commands: list[tuple[list[str], int, bool]] = []
    for line in console_commands(page):
        if not any(word in line for word in NOT_RUN):
            words = shlex.split(line.split(" > ")[0])[1:]
            commands.append((words, EXIT_CODES.get(line, 0), " plan " in line))
    run("-c", COMMANDS, json.dumps(commands), cwd=project)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in DOCS if programs(page)], ids=label)
def test_programs_of_page_run_in_order(project: Path, page: Path) -> None:
    run("-c", "\n".join(programs(page)), cwd=project)


def test_migration_table_names_existing_settings() -> None:
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


@pytest.mark.parametrize("page", DOCS, ids=label)
def test_page_opens_with_what_the_reader_can_do(page: Path) -> None:
    paragraphs = re.sub(r"^<!--.*-->\n\n", "", TEXT[page]).split("\n\n")
    assert paragraphs[0].startswith("# ")
    assert paragraphs[1].startswith("After reading this page, you ")


def test_pre_commit_hook_of_the_ci_page_equals_the_published_hook() -> None:
    text = TEXT[ROOT / "docs" / "ci.md"]
    block = next(
        block for block in re.findall(r"```yaml\n(.*?)```", text, re.DOTALL) if "repo: local" in block
    )
    hook = yaml.safe_load(block)["repos"][0]["hooks"][0]
    hooks = yaml.safe_load((ROOT / ".pre-commit-hooks.yaml").read_text(encoding="utf-8"))
    published = next(each for each in hooks if each["id"] == hook["id"])
    same = ("id", "name", "entry", "files", "pass_filenames")
    assert {key: hook[key] for key in same} == {key: published[key] for key in same}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "docs/migration.md"])
def test_program_that_uses_the_injector_passes_a_strict_type_check(tmp_path: Path, name: str) -> None:
    pytest.importorskip("pyright", reason="pyright is not installed")
    program = next(code for code in programs(ROOT / name) if "RosbagInjector(" in code)
    (tmp_path / "program.py").write_text(program)
    settings = {"typeCheckingMode": "strict", "extraPaths": [str(ROOT)], "reportMissingTypeStubs": False}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    run("-m", "pyright", "--pythonpath", sys.executable, "--project", str(tmp_path), cwd=tmp_path)


def test_paths_in_contributing_exist() -> None:
    text = re.sub(r"```.*?```", "", TEXT[ROOT / "CONTRIBUTING.md"], flags=re.DOTALL)
    paths = [
        name for name in re.findall(r"`([\w./-]+)`", text) if name.endswith((".py", ".md", ".toml", "/"))
    ]
    assert len(paths) > 10
    folders = (ROOT, ROOT / "mosaico_ingest")
    assert not [path for path in paths if not any((folder / path).exists() for folder in folders)]


def test_contributing_lists_every_package_and_only_what_exists() -> None:
    package = ROOT / "mosaico_ingest"
    packages = {path.parent.name for path in package.glob("*/__init__.py")}
    modules = {path.stem for path in package.glob("*.py")}
    rows = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \|", TEXT[ROOT / "CONTRIBUTING.md"], re.MULTILINE)
    names = {name for row in rows for name in re.findall(r"\w+", row)}
    assert packages <= names <= packages | modules
