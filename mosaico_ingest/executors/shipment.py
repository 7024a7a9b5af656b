"""Packing of the adapters and message definitions that jobs name by path, for machines that do not have them."""

from __future__ import annotations

import shutil
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from os.path import abspath
from pathlib import Path

from msgspec import Struct, structs

from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.destinations.base import destination_of
from mosaico_ingest.job.fields import AdapterRef, FilePath, PathRole, marked_fields, replace_values, values_at
from mosaico_ingest.job.model import JobSettings
from mosaico_ingest.metadata.validation import schema_files
from mosaico_ingest.pipeline.task import Task
from mosaico_ingest.remote import is_url
from mosaico_ingest.rosbag.definitions.registry import definition_files

_FILES = "files"
"""The folder of the shipment that mirrors the paths of this machine."""
_HERE = ".here"
"""The name of the empty file that keeps a folder in the shipment."""
_YAML = frozenset({".yaml", ".yml"})
_CODE = _YAML | {".py"}
_SHIPPED = {PathRole.WORKER_FILE, PathRole.DEFINITIONS, PathRole.SCHEMA}


def absolute(task: Task) -> Task:
    """Return a task with absolute paths."""
    job = task.job
    store = destination_of(job.destination).local_folder if job.target.type is None else None
    if store is not None:
        job = job.replace(target=job.target.replace(store=str(store)))
    for field in marked_fields(JobSettings, FilePath):
        if field.marker.role is not PathRole.RECORDING:
            job = replace_values(
                job, field.path, lambda _, path: path if is_url(path) else str(_absolute(path))
            )
    return structs.replace(
        task,
        job=job.replace(
            paths=tuple(_absolute(path) if isinstance(path, Path) else path for path in job.paths),
            origin=structs.replace(job.origin, folder=_absolute(job.folder)),
        ),
    )


def pack(tasks: Iterable[Task], folder: Path) -> list[Task]:
    """Copy adapters, definitions and certificates into `folder`; return tasks that are valid in a copy of it.

    Adapters keep their names, so the plan stays the same. Adapters with an absolute path and installed packages are not
    copied and must exist on every machine.
    """
    packer = _Packer(folder)
    return [packer.add(task) for task in tasks]


class _Packer(Struct, frozen=True):
    folder: Path

    def add(self, task: Task) -> Task:
        job = task.job
        for field in marked_fields(JobSettings, AdapterRef):
            for _, reference in values_at(job, field.path):
                self._add_adapter(reference, job.folder)
        for field in marked_fields(JobSettings, FilePath):
            if field.marker.role in _SHIPPED:
                add = self._add_schema if field.marker.role is PathRole.SCHEMA else self._add_input
                job = replace_values(job, field.path, add)
        self._add_all([], folder=job.folder)
        return structs.replace(task, job=job, code_dir=_shipped(job.folder))

    def _add_input(self, _: object, path: str) -> str:
        """Add a file, or the message definitions of a folder; return its path in the shipment."""
        self._add_all(definition_files(Path(path)) if Path(path).is_dir() else [Path(path)])
        return str(_shipped(path))

    def _add_schema(self, _: object, path: str) -> str:
        """Add a JSON Schema with the files that it refers to; return its path in the shipment."""
        self._add_all(schema_files(Path(path)))
        return str(_shipped(path))

    def _add_adapter(self, reference: object, base_dir: Path) -> None:
        """Copy the file or module of a reference with its neighbors, which it may import."""
        if isinstance(reference, type):
            self._add_module(reference.__module__, base_dir)
        elif isinstance(reference, (str, Path)) and str(reference) not in BY_NAME:
            source, colon, _ = str(reference).rpartition(":")
            if Path(reference).suffix in _YAML:
                self._add_all(_beside(base_dir / reference, _YAML))
            elif source.endswith(".py"):
                self._add_all(_beside(base_dir / source, _CODE))
            elif colon:
                self._add_module(source, base_dir)

    def _add_module(self, name: str, base_dir: Path) -> None:
        """Copy a module with its package unless it is installed: into the import path, or below `base_dir`."""
        file = getattr(sys.modules.get(name.partition(".")[0]), "__file__", None)
        if file is None or _is_installed(Path(file)):
            return
        source = Path(file).parent if Path(file).name == "__init__.py" else Path(file)
        files = [source] if source.is_file() else _matching(source.rglob("*"), _CODE)
        if source.parent == base_dir:
            self._add_all(files)
        else:
            for code in files:
                _copy(code, self.folder / code.relative_to(source.parent))

    def _add_all(self, files: Iterable[Path], *, folder: Path | None = None) -> None:
        for file in files:
            _copy(file, self.folder / _shipped(file))
        if folder is not None:  # `../adapters` needs its folder, and shipments contain no empty folders
            marker = self.folder / _shipped(folder) / _HERE
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.touch()


def _beside(file: Path, suffixes: frozenset[str]) -> Iterator[Path]:
    """Yield the files in the folder of a file, and the files of the packages in that folder."""
    folder = _absolute(file).parent
    yield from _matching(folder.iterdir(), suffixes)
    for package in folder.glob("*/__init__.py"):
        yield from _matching(package.parent.rglob("*"), suffixes)


def _matching(paths: Iterable[Path], suffixes: frozenset[str]) -> list[Path]:
    return [path for path in paths if path.suffix in suffixes and path.is_file()]


def _shipped(path: Path | str) -> Path:
    """Return the path of a file in the shipment."""
    return Path(_FILES, *_absolute(path).parts[1:])


def _absolute(path: Path | str) -> Path:
    return Path(abspath(path))  # noqa: PTH100 - keep links, which may be the path that all machines share


def _copy(source: Path, to: Path) -> None:
    if not to.exists():
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, to)


def _is_installed(file: Path) -> bool:
    folders = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return any(file.is_relative_to(folder) for folder in folders)
