"""The documentation site: its navigation, the copy of all pages with links that work there, and the list of pages."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CONFIGURATION = ROOT / "mkdocs.yml"
SITE = ROOT / ".site"
"""The folder of the site; `ingest lint` ignores hidden folders."""
PROJECT = "project"
"""The folder of the site for files of the repository outside docs/."""
LINK = re.compile(r"(!?\[[^\]\n]*\]\()(?!https?://|mailto:|#)([^)#\s]+)(#[^)\s]*)?(\))")
CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)
LIST_START, LIST_END = "<!-- pages: generated from mkdocs.yml -->\n", "<!-- end of pages -->\n"
ABILITY = re.compile(r"^After reading this page, you (.+?[.:])(?:\s|$)", re.MULTILINE | re.DOTALL)


def navigation() -> dict[str, dict[str, Path]]:
    """Return the file of each page by section and title; pages at the top level are in the section ``."""
    sections: dict[str, dict[str, Path]] = {"": {}}
    for entry in yaml.safe_load(CONFIGURATION.read_text(encoding="utf-8"))["nav"]:
        ((title, value),) = entry.items()
        if isinstance(value, str):
            sections[""][title] = source(value)
        else:
            sections[title] = {name: source(path) for page in value for name, path in page.items()}
    return sections


def source(path: str) -> Path:
    """Return the file in the repository of a page of the site."""
    return ROOT / path.removeprefix(f"{PROJECT}/") if path.startswith(f"{PROJECT}/") else DOCS / path


def page_list() -> str:
    """Return a table for each section of the navigation, with the opening sentence of each page."""
    lines: list[str] = []
    for section, pages in navigation().items():
        lines += [
            "",
            f"## {section}" if section else "## Overview",
            "",
            "| page | after reading it, you |",
            "|---|---|",
        ]
        for title, path in pages.items():
            if path != DOCS / "README.md":
                link = Path(os.path.relpath(path, DOCS)).as_posix()
                lines.append(f"| [{title}]({link}) | {ability(path)} |")
    return "\n".join([*lines, ""])


def ability(page: Path) -> str:
    """Return the rest of the opening sentence of a page."""
    match = ABILITY.search(page.read_text(encoding="utf-8"))
    if match is None:
        raise ValueError(f"{page} does not open with `After reading this page, you …`")
    return re.sub(r"\s+", " ", match[1]).rstrip(".:").replace("|", "\\|")


def readme_with_page_list() -> str:
    """Return docs/README.md with the current list of pages."""
    before, rest = (DOCS / "README.md").read_text(encoding="utf-8").split(LIST_START)
    return f"{before}{LIST_START}{page_list()}{LIST_END}{rest.split(LIST_END)[1]}"


def write_sources(folder: Path) -> None:
    """Copy the settings, the pages and all files that they link to, with links that work on the site."""
    shutil.copy(CONFIGURATION, folder)
    settings: Any = yaml.safe_load(CONFIGURATION.read_text(encoding="utf-8"))
    python: Any = settings["plugins"][1]["mkdocstrings"]["handlers"]["python"]
    python["paths"] = [str(ROOT)]
    (folder / "mkdocs.yml").write_text(yaml.safe_dump(settings, sort_keys=False), encoding="utf-8")
    waiting = [*DOCS.rglob("*.*"), *(path for pages in navigation().values() for path in pages.values())]
    copied: set[Path] = set()
    while waiting:
        path = waiting.pop().resolve()
        if path in copied or not path.is_file():
            continue
        copied.add(path)
        target = folder / "docs" / site_path(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            text = path.read_text(encoding="utf-8")
            waiting += linked_files(path, text)
            target.write_text(with_site_links(path, text), encoding="utf-8")
        else:
            shutil.copy(path, target)


def site_path(path: Path) -> Path:
    """Return the path of a file of the repository on the site."""
    if path == ROOT / "README.md":
        return Path("README.md")
    return path.relative_to(DOCS) if path.is_relative_to(DOCS) else PROJECT / path.relative_to(ROOT)


def linked_files(page: Path, text: str) -> Iterator[Path]:
    """Yield the files that a page links to; a folder stands for its README.md."""
    for match in LINK.finditer(CODE.sub("", text)):
        yield linked_file(page, match[2])


def linked_file(page: Path, link: str) -> Path:
    """Return the file to which a link leads."""
    path = (page.parent / link).resolve()
    return path / "README.md" if path.is_dir() else path


def with_site_links(page: Path, text: str) -> str:
    """Return a page with its links and code adapted to the site."""
    here = site_path(page).parent

    def replaced(match: re.Match[str]) -> str:
        file = linked_file(page, match[2])
        if not file.is_file():
            return match[1][1:-2]  # a folder without a page
        link = Path(os.path.relpath(site_path(file), here)).as_posix()
        return f"{match[1]}{link}{match[3] or ''}{match[4]}"

    parts = CODE.split(text)
    return "".join(_site_code(part) if at % 2 else LINK.sub(replaced, part) for at, part in enumerate(parts))


def _site_code(code: str) -> str:
    """Return code with plain `|`: tables on GitHub require it escaped, and the site requires it unescaped."""
    return code if code.startswith("```") else code.replace("\\|", "|")


def build(folder: Path, site: Path) -> None:
    """Build the site in strict mode: a broken link or anchor is an error."""
    folder.mkdir(parents=True, exist_ok=True)
    write_sources(folder)
    subprocess.run([sys.executable, "-m", "zensical", "build", "--strict"], cwd=folder, check=True)
    shutil.rmtree(site, ignore_errors=True)
    shutil.move(folder / "site", site)


if __name__ == "__main__":
    if sys.argv[1:] == ["--list"]:
        (DOCS / "README.md").write_text(readme_with_page_list(), encoding="utf-8")
    else:
        with tempfile.TemporaryDirectory() as sources:
            build(Path(sources), SITE)
        sys.stdout.write(f"open {SITE}/index.html\n")
