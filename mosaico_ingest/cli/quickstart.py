"""`ingest quickstart`, and the suggestions of `ingest` without arguments."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from mosaico_ingest.errors import ManifestError

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = (_PACKAGE / "quickstart", _PACKAGE.parent / "configs")
"""The folder of the files in an installed wheel, and in a checkout."""
_MANIFEST = re.compile(r"^bag:", re.MULTILINE)
_MAX_ENTRIES = 1000
"""Number of entries of a folder that suggestions consider."""
_MANIFEST_BYTES = 1 << 16
"""Number of bytes of a YAML file in which suggestions look for the section `bag`."""


def quickstart(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="The folder to write, which must not exist.")
    ] = Path("quickstart"),
) -> None:
    """Write a small recording with its manifest, adapter and message definitions into a folder."""
    from mosaico_ingest.cli.console import print_line

    source = next(each for each in _FOLDERS if (each / "quickstart.yaml").is_file())
    if folder.exists():
        raise ManifestError("the folder exists", where=str(folder), hint="name another folder, or remove it")
    shutil.copytree(
        source / "quickstart", folder / "quickstart", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(source / "quickstart.yaml", folder)
    print_line(f"wrote {folder}; ingest it with: ingest {shlex.quote(str(folder / 'quickstart.yaml'))}")


def suggestions(folder: Path) -> list[str]:
    """Return the lines that suggest commands for the content of a folder; none if it has nothing to ingest."""
    entries = sorted(islice((path for path in folder.iterdir() if path.name[0] != "."), _MAX_ENTRIES))
    manifests = [path.name for path in entries if _is_manifest(path)]
    recordings = list(_recordings(entries))
    lines: list[str] = []
    if manifests:
        job = shlex.quote(manifests[0])
        lines += [
            f"{_count(manifests, 'job manifest')}:",
            f"  ingest plan {job}",
            f"  ingest {job}",
        ]
    if recordings:
        bag = shlex.quote(recordings[0])
        lines += [
            f"{_count(recordings, 'recording')}:",
            f"  ingest inspect {bag}",
            f"  ingest bag {bag}",
            f"  ingest init {bag}",
        ]
    if (folder / "mosaico" / "catalog.sqlite").is_file():
        lines += ["a store with ingested sequences, mosaico:", "  ingest store ls", "  ingest browse"]
    return lines


def _count(names: list[str], noun: str) -> str:
    return f"1 {noun}, {names[0]}" if len(names) == 1 else f"{len(names)} {noun}s, such as {names[0]}"


def _is_manifest(path: Path) -> bool:
    if path.suffix not in {".yaml", ".yml"} or not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            return bool(_MANIFEST.search(file.read(_MANIFEST_BYTES).decode("utf-8", "replace")))
    except OSError:
        return False


def _recordings(entries: list[Path]) -> Iterator[str]:
    from mosaico_ingest.containers import RECORDING_NAME

    for path in entries:
        is_file = path.is_file() and RECORDING_NAME.search(path.name)
        if is_file or (path.is_dir() and (path / "metadata.yaml").is_file()):
            yield path.name
