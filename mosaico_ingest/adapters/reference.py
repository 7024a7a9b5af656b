"""This file finds an adapter from what a job calls it: a class, a name of the catalog, a file, `module:Class`."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from difflib import get_close_matches
from hashlib import sha1
from pathlib import Path
from types import ModuleType
from typing import cast

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.builtin import BY_NAME
from mosaico_ingest.adapters.mapping.load import load_adapter
from mosaico_ingest.adapters.python_adapter import PythonAdapterSpec, is_adapter_class
from mosaico_ingest.adapters.unmodeled import UnmodeledSpec
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.textfile import read_whole

__all__ = ["KnownAdapters", "adapter_spec", "load_adapter_reference", "what_was_meant"]

_MAPPING_SUFFIXES = frozenset({".yaml", ".yml"})


def adapter_spec(adapter: object, base_dir: Path) -> AdapterSpec:
    """Return the spec an adapter is given by: a spec itself, a class, or a reference as text or path.

    Raises:
        AdapterError: It stands for none.
    """
    if isinstance(adapter, (str, Path)):
        return load_adapter_reference(str(adapter), base_dir)
    if isinstance(adapter, type):
        if "__adapter_spec__" in vars(adapter):  # a built-in's own class, not one that extends it
            return vars(adapter)["__adapter_spec__"]
        if is_adapter_class(adapter):
            return PythonAdapterSpec(adapter)
    elif hasattr(adapter, "bind") and hasattr(adapter, "ros_types"):
        return cast("AdapterSpec", adapter)  # it has what the protocol asks for
    raise AdapterError(
        f"{_spell(adapter)} is no adapter", hint="give a subclass of ROSAdapterBase, or a reference to one"
    )


def load_adapter_reference(ref: str, base_dir: Path) -> AdapterSpec:
    """Find `LidarAdapter`, `adapters/pack.yaml`, `pkg.module:Class` or `path/to/file.py:Class`.

    Paths start at `base_dir`; a module is looked for where Python looks, then there.

    Raises:
        AdapterError: There is none, or its file has a mistake: names the file and the line.
    """
    if ref in BY_NAME:
        return BY_NAME[ref]
    if ref == UnmodeledSpec().name:
        return UnmodeledSpec()
    if Path(ref).suffix in _MAPPING_SUFFIXES:
        return _load_mapping(base_dir / ref)
    place, colon, qualname = ref.rpartition(":")
    if not colon or not place or not qualname:
        raise AdapterError(f"no adapter is called {ref!r}", hint=what_was_meant(ref, BY_NAME))
    module = _load_file(base_dir / place) if place.endswith(".py") else _load_module(place, base_dir)
    found = _attribute(module, qualname, ref)
    spec = adapter_spec(found, base_dir)
    if isinstance(spec, PythonAdapterSpec):
        return PythonAdapterSpec(spec.adapter, origin=(load_adapter_reference, (ref, base_dir)))
    return spec


def what_was_meant(ref: str, known: Iterable[str] = ()) -> str:
    """Return what to write instead of a name that no adapter has."""
    if ref.endswith(".py"):
        return f"name the class in it: {ref}:Class"
    if near := get_close_matches(ref, list(known), n=1, cutoff=0.6):
        return f"did you mean {near[0]}?"
    return "see `ingest adapters list`, or write a YAML path, module:Class or file.py:Class"


@frozen
class KnownAdapters:
    """Finds the adapters a mapping may use: the built-in ones, and those of the files beside it."""

    folder: Path

    def __call__(self, name: str) -> AdapterSpec | None:
        """Return the adapter of that name, None where there is none."""
        if name in BY_NAME:
            return BY_NAME[name]
        said = re.compile(rf"^adapter:\s*['\"]?{re.escape(name)}['\"]?\s*(#|$)", re.MULTILINE)
        files = sorted(path for path in self.folder.iterdir() if path.suffix in _MAPPING_SUFFIXES)
        found = next((path for path in files if said.search(_text_of(path))), None)
        return None if found is None else _load_mapping(found)


def _text_of(path: Path) -> str:
    """Return what a file beside a mapping says; nothing where it cannot be read."""
    try:
        return read_whole(path).decode("utf-8", "replace")
    except OSError:
        return ""


def _load_mapping(path: Path) -> AdapterSpec:
    return load_adapter(path, adapters=KnownAdapters(path.parent))


def _attribute(module: ModuleType, qualname: str, ref: str) -> object:
    found: object = module
    for name in qualname.split("."):
        if not hasattr(found, name):
            classes = [name for name, value in vars(module).items() if is_adapter_class(value)]
            near = get_close_matches(qualname, classes, n=1)
            known = near or [name for name in classes if name != "ROSAdapterBase"]
            raise AdapterError(
                f"{ref.rpartition(':')[0]} has no {qualname}",
                hint=f"did you mean {near[0]}?" if near else f"its adapters are {', '.join(known) or 'none'}",
            )
        found = getattr(found, name)
    return found


def _load_module(name: str, base_dir: Path) -> ModuleType:
    with _also_searched(base_dir):
        try:
            return importlib.import_module(name)
        except Exception as error:
            if isinstance(error, ModuleNotFoundError) and name.startswith(error.name or "?"):
                raise AdapterError(
                    f"there is no module {error.name}",
                    hint=f"install it, put it into {base_dir}, or write path/to/file.py:Class",
                ) from error
            raise _broken(name, error) from error


def _load_file(path: Path) -> ModuleType:
    path = path.resolve()
    name = f"mosaico_ingest_adapters_{path.stem}_{sha1(str(path).encode(), usedforsecurity=False).hexdigest()[:8]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if not path.is_file() or spec is None or spec.loader is None:
        raise AdapterError(f"there is no file {path}", hint="the path starts at the folder of the manifest")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _also_searched(path.parent):
            spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise _broken(str(path), error) from error
    return module


@contextmanager
def _also_searched(folder: Path) -> Generator[None]:
    """Let imports find modules in `folder`, after everything that is installed."""
    entry = str(folder.resolve())
    if entry in sys.path:  # and there it stays
        yield
        return
    sys.path.append(entry)
    try:
        yield
    finally:
        sys.path.remove(entry)


def _broken(name: str, error: Exception) -> AdapterError:
    """Say where an import failed: in the deepest line that is the user's own, if one is."""
    if isinstance(error, SyntaxError) and error.filename:
        place = f"{error.filename}:{error.lineno}"
    else:
        frames = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if "importlib" not in frame.filename and frame.filename != __file__
        ]
        own = [frame for frame in frames if "site-packages" not in frame.filename] or frames
        place = f"{own[-1].filename}:{own[-1].lineno}" if own else name
    text = " ".join(str(error).split())
    return AdapterError(f"importing {name} failed: {type(error).__name__}: {text}", where=place)


def _spell(candidate: object) -> str:
    return (
        candidate.__qualname__
        if isinstance(candidate, type)
        else f"{type(candidate).__name__} {candidate!r:.60}"
    )
