"""This file gathers the code and the definitions that jobs name by path, for machines that do not have them."""

from __future__ import annotations

import shutil
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from dataclasses import replace
from os.path import abspath
from pathlib import Path

from msgspec import Struct, structs

from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.destinations.registry import destination_of
from mosaico_ingest.job.config import ROSInjectionConfig
from mosaico_ingest.remote import AnyPath
from mosaico_ingest.rosbag.definitions.registry import definition_files

__all__ = ["absolute", "pack"]

_FILES = "files"
"""The folder of the shipment in which everything lies as it does here."""
_HERE = ".here"
_YAML = frozenset({".yaml", ".yml"})
_CODE = _YAML | {".py"}


def absolute(config: ROSInjectionConfig) -> ROSInjectionConfig:
    """Return a configuration whose paths mean the same in every folder."""
    kept, store = config.quarantine, destination_of(config.target).local_folder
    cert = config.tls_cert_path
    return replace(
        config,
        file_path=tuple(_anywhere(path) for path in config.paths),
        store=config.store if store is None or config.plugin else _absolute(store),
        plugin=config.plugin and structs.replace(config.plugin, base_dir=_absolute(config.plugin.base_dir)),
        base_dir=_absolute(config.base_dir),
        quarantine=None if kept is None else replace(kept, path=_anywhere(kept.path)),
        custom_msgs=tuple((package, _absolute(path), store) for package, path, store in config.custom_msgs),
        tls_cert_path=None if cert is None else _absolute(cert),
    )


def pack(configs: Iterable[ROSInjectionConfig], folder: Path) -> list[ROSInjectionConfig]:
    """Copy adapters, definitions and certificates into `folder`; return configurations that are valid inside a copy of it.

    Adapters keep the names the manifests give them, so the plan is the same. One named by an absolute path, and
    what is installed, must be there on every machine.
    """
    box = _Box(folder)
    return [box.add(config) for config in configs]


class _Box(Struct, frozen=True):
    folder: Path

    def add(self, config: ROSInjectionConfig) -> ROSInjectionConfig:
        for reference in (*config.adapters, *config.adapter_override.values()):
            self._add_adapter(reference, config.base_dir)
        for _, path, _ in config.custom_msgs:
            self._add_all(definition_files(Path(path)))
        cert = config.tls_cert_path
        self._add_all([] if cert is None else [Path(cert)])
        self._add_all([], folder=config.base_dir)
        return replace(
            config,
            code_dir=_place(config.base_dir),
            custom_msgs=tuple((package, _place(path), store) for package, path, store in config.custom_msgs),
            tls_cert_path=None if cert is None else _place(cert),
        )

    def _add_adapter(self, reference: object, base_dir: Path) -> None:
        """Add what a reference names, and what lies beside it: it may use that."""
        if isinstance(reference, type):
            self._add_module(reference.__module__, base_dir)
        elif isinstance(reference, (str, Path)) and str(reference) not in BY_NAME:
            place, colon, _ = str(reference).rpartition(":")
            if Path(reference).suffix in _YAML:
                self._add_all(_beside(base_dir / reference, _YAML))
            elif place.endswith(".py"):
                self._add_all(_beside(base_dir / place, _CODE))
            elif colon:
                self._add_module(place, base_dir)

    def _add_module(self, name: str, base_dir: Path) -> None:
        """Add a module with all of its package, unless it is installed; where Python looks, or below `base_dir`."""
        file = getattr(sys.modules.get(name.partition(".")[0]), "__file__", None)
        if file is None or _is_installed(Path(file)):
            return
        source = Path(file).parent if Path(file).name == "__init__.py" else Path(file)
        files = [source] if source.is_file() else _matching(source.rglob("*"), _CODE)
        if source.parent == base_dir:
            self._add_all(files)
        else:
            for one in files:
                _copy(one, self.folder / one.relative_to(source.parent))

    def _add_all(self, files: Iterable[Path], *, folder: Path | None = None) -> None:
        for file in files:
            _copy(file, self.folder / _place(file))
        if folder is not None:  # a shipment has no empty folders, and `../adapters` starts in one
            kept = self.folder / _place(folder) / _HERE
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.touch()


def _beside(file: Path, suffixes: frozenset[str]) -> Iterator[Path]:
    """Yield the files of a file's folder, and those of the packages in it."""
    folder = _absolute(file).parent
    yield from _matching(folder.iterdir(), suffixes)
    for package in folder.glob("*/__init__.py"):
        yield from _matching(package.parent.rglob("*"), suffixes)


def _matching(paths: Iterable[Path], suffixes: frozenset[str]) -> list[Path]:
    return [path for path in paths if path.suffix in suffixes and path.is_file()]


def _place(path: Path | str) -> Path:
    """Return where a file lies in the shipment."""
    return Path(_FILES, *_absolute(path).parts[1:])


def _anywhere(path: AnyPath) -> AnyPath:
    return _absolute(path) if isinstance(path, Path) else path


def _absolute(path: Path | str) -> Path:
    return Path(abspath(path))  # noqa: PTH100 - links stay: a link may be the name that is the same everywhere


def _copy(source: Path, to: Path) -> None:
    if not to.exists():
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, to)


def _is_installed(file: Path) -> bool:
    places = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return any(file.is_relative_to(place) for place in places)
