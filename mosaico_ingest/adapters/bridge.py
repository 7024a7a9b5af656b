"""Resolve adapter references and choose the adapter of each topic."""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from enum import Enum
from functools import cache
from hashlib import sha1
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Literal, cast

from msgspec import Struct
from msgspec.structs import replace

from mosaico_ingest.adapters.adapter import AdapterSpec, EncodedImageSpec, UnmodeledSpec
from mosaico_ingest.adapters.builtin import BY_NAME, BY_TYPE, Builtin
from mosaico_ingest.adapters.mapping.loader import MappingSpec, load_adapter
from mosaico_ingest.adapters.python import (
    PythonAdapterSpec,
    ROSAdapterBase,
    is_adapter_class,
    is_python_allowed,
    python_refusal,
    registered_adapters,
)
from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.job.fields import ImageFormat, ImageSettings, ParameterizedAdapter, image_settings
from mosaico_ingest.job.values import first_match
from mosaico_ingest.ontology.registry import SerializationFormat
from mosaico_ingest.rosbag.definitions.model import normalize_msgtype

if TYPE_CHECKING:
    from mosaico_ingest.job.model import Job
    from mosaico_ingest.ontology.model import Message
    from mosaico_ingest.rosbag.blocks import ROSMessage

_MAPPING_SUFFIXES = frozenset({".yaml", ".yml"})
_ADAPTER_KEY = re.compile(r"^adapter:\s*['\"]?(?P<name>\w+)['\"]?\s*(#|$)", re.MULTILINE)
"""The name of the adapter in an adapter file, found without parsing the file."""


def adapter_spec(adapter: object, base_dir: Path, *, python: bool = True) -> AdapterSpec:
    """Return the spec for a spec, an adapter class, or a reference as text or path.

    Raises:
        AdapterError: The object is not an adapter, or `python` is false and the adapter is written in Python.
    """
    if isinstance(adapter, (str, Path)):
        return load_adapter_reference(str(adapter), base_dir, python=python)
    if isinstance(adapter, ParameterizedAdapter):
        spec = adapter_spec(adapter.file, base_dir, python=python)
        if not isinstance(spec, MappingSpec):
            raise AdapterError(f"{spec.name} has no parameters", hint="give the path of an adapter file")
        return spec.with_parameters(adapter.values)
    if isinstance(adapter, type):
        if "__adapter_spec__" in vars(adapter):  # the class of a built-in adapter, but not a subclass
            return vars(adapter)["__adapter_spec__"]
        if is_adapter_class(adapter):
            _check_permission(adapter.__qualname__, allowed=python)
            return PythonAdapterSpec(adapter)
    elif hasattr(adapter, "bind") and hasattr(adapter, "ros_types"):
        return cast("AdapterSpec", adapter)  # it implements the protocol
    raise AdapterError(
        f"{_spell(adapter)} is not an adapter",
        hint="give a subclass of ROSAdapterBase, or a reference to one",
    )


def outputs_of(spec: AdapterSpec) -> tuple[MappingSpec, ...]:
    """Return the adapter of each output of a file with `outputs`; () for any other adapter."""
    inner = spec.inner if isinstance(spec, EncodedImageSpec) else spec
    return inner.outputs if isinstance(inner, MappingSpec) else ()


def load_adapter_reference(ref: str, base_dir: Path, *, python: bool = True) -> AdapterSpec:
    """Load the adapter that a reference names: `LidarAdapter`, `adapters/pack.yaml`, `pkg.module:Class` or `file.py:Class`.

    Paths are relative to `base_dir`. Modules are imported from Python's search path, then from `base_dir`.

    Raises:
        AdapterError: There is no such adapter, its file has a mistake (the error has file and line), or it is written in
            Python although `python` is false.
    """
    if ref in BY_NAME:
        return BY_NAME[ref]
    if ref == UnmodeledSpec().name:
        return UnmodeledSpec()
    if Path(ref).suffix in _MAPPING_SUFFIXES:
        return _load_mapping(base_dir / ref)
    module_path, colon, qualname = ref.rpartition(":")
    if not colon or not module_path or not qualname:
        raise AdapterError(f"there is no adapter {ref!r}", hint=suggest_reference(ref, BY_NAME))
    _check_permission(ref, allowed=python)
    module = (
        _load_file(base_dir / module_path)
        if module_path.endswith(".py")
        else _load_module(module_path, base_dir)
    )
    value = _attribute(module, qualname, ref)
    spec = adapter_spec(value, base_dir)
    if isinstance(spec, PythonAdapterSpec):
        return PythonAdapterSpec(spec.adapter, origin=(load_adapter_reference, (ref, base_dir)))
    return spec


def _check_permission(reference: str, *, allowed: bool) -> None:
    if not (allowed and is_python_allowed()):
        message, hint = python_refusal(reference)
        raise AdapterError(message, hint=hint)


def suggest_reference(ref: str, names: Iterable[str] = ()) -> str:
    """Return the hint for a reference that names no adapter."""
    if ref.endswith(".py"):
        return f"name the class in it: {ref}:Class"
    if nearest := get_close_matches(ref, list(names), n=1, cutoff=0.6):
        return f"did you mean {nearest[0]}?"
    return "see `ingest adapters list`, or write a YAML path, module:Class or file.py:Class"


class AdapterFinder(Struct, frozen=True):
    """Finds the adapters that a mapping may use: the built-in ones, and those in the files of its folder."""

    folder: Path

    def __call__(self, name: str) -> AdapterSpec | None:
        """Return the adapter of a name, None if there is none."""
        if name in BY_NAME:
            return BY_NAME[name]
        for path in self._files():
            match = _ADAPTER_KEY.search(_text_of(path))
            if match and match["name"] == name:
                return _load_mapping(path)
        return None

    def names(self) -> Iterable[str]:
        """Return the names of the built-in adapters and of those in the folder."""
        matches = (_ADAPTER_KEY.search(_text_of(path)) for path in self._files())
        return [*BY_NAME, *(match["name"] for match in matches if match)]

    def _files(self) -> list[Path]:
        return sorted(path for path in self.folder.iterdir() if path.suffix in _MAPPING_SUFFIXES)


def _text_of(path: Path) -> str:
    """Return the text of a file next to a mapping, or an empty text if it cannot be read."""
    try:
        return read_limited(path).decode("utf-8", "replace")
    except OSError:
        return ""


def _load_mapping(path: Path) -> AdapterSpec:
    return load_adapter(path, adapters=AdapterFinder(path.parent))


def _attribute(module: ModuleType, qualname: str, ref: str) -> object:
    value: object = module
    for name in qualname.split("."):
        if not hasattr(value, name):
            classes = [name for name, value in vars(module).items() if is_adapter_class(value)]
            nearest = get_close_matches(qualname, classes, n=1)
            names = nearest or [name for name in classes if name != "ROSAdapterBase"]
            raise AdapterError(
                f"{ref.rpartition(':')[0]} has no {qualname}",
                hint=f"did you mean {nearest[0]}?"
                if nearest
                else f"its adapters are {', '.join(names) or 'none'}",
            )
        value = getattr(value, name)
    return value


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
        raise AdapterError(f"there is no file {path}", hint="write a path relative to the manifest")
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
    """Let imports also find modules in `folder`, after the installed packages."""
    entry = str(folder.resolve())
    if entry in sys.path:
        yield
        return
    sys.path.append(entry)
    try:
        yield
    finally:
        sys.path.remove(entry)


def _broken(name: str, error: Exception) -> AdapterError:
    """Return the error for a failed import, located at the deepest line of the user's own code."""
    if isinstance(error, SyntaxError) and error.filename:
        location = f"{error.filename}:{error.lineno}"
    else:
        frames = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if "importlib" not in frame.filename and frame.filename != __file__
        ]
        own_frames = [frame for frame in frames if "site-packages" not in frame.filename] or frames
        location = f"{own_frames[-1].filename}:{own_frames[-1].lineno}" if own_frames else name
    text = " ".join(str(error).split())
    return AdapterError(f"importing {name} failed: {type(error).__name__}: {text}", where=location)


def _spell(candidate: object) -> str:
    return (
        candidate.__qualname__
        if isinstance(candidate, type)
        else f"{type(candidate).__name__} {candidate!r:.60}"
    )


ENTRY_POINTS = "mosaico_ingest.adapters"
"""The entry point group in which installed packages offer adapters: a class, a spec, or a list of them."""

Reason = Literal["override", "loaded", "registered", "entry point", "built-in", "unmodeled"]


class Resolution(Struct, frozen=True):
    """The adapter of a topic, and the reason for the choice."""

    spec: AdapterSpec
    reason: Reason
    why: str

    @property
    def unmodeled(self) -> bool:
        """Whether no adapter takes the type."""
        return self.reason == "unmodeled"


class ROSBridge:
    """The adapters of a run: overrides by topic; then loaded, registered, installed and built-in ones by type."""

    def __init__(
        self,
        *,
        overrides: Mapping[str, object] | None = None,
        loaded: Iterable[object] = (),
        base_dir: Path | None = None,
        images: Mapping[str, ImageSettings | ImageFormat] | None = None,
        formats: Mapping[str, str] | None = None,
        python: bool = True,
    ) -> None:
        """Load all adapters; `base_dir` is the folder for relative paths.

        `overrides` and `images` are by topic name or glob, `formats` (of types without an adapter) by type. Without
        `python`, references to adapters in Python are refused, and adapters of installed packages and of the program are not used.

        Raises:
            AdapterError: An adapter is missing or has a mistake, or two are loaded for one type.
        """
        folder = base_dir or Path()
        specs = [(str(reference), adapter_spec(reference, folder, python=python)) for reference in loaded]
        installed = installed_adapters() if python else ()
        self._loaded = _by_type((f"loaded from {origin}", spec) for origin, spec in specs)
        self._installed = _by_type(installed)
        self._registered = _registered() if python else {}
        names = {spec.name: spec for _, spec in (*installed, *specs)}
        self._overrides = {
            pattern: names.get(reference) or adapter_spec(reference, folder, python=python)
            if isinstance(reference, str)
            else adapter_spec(reference, folder, python=python)
            for pattern, reference in (overrides or {}).items()
        }
        self._images = {pattern: image_settings(value) for pattern, value in (images or {}).items()}
        self._formats = {normalize_msgtype(name): _layout(value) for name, value in (formats or {}).items()}

    @classmethod
    def for_job(cls, job: Job, *, folder: Path | None = None) -> ROSBridge:
        """Return the bridge of a job; relative paths start at `folder`, by default the manifest's folder.

        Raises:
            AdapterError: As in the constructor.
        """
        return cls(
            overrides=job.adapters.override,
            loaded=job.adapters.load,
            base_dir=job.folder if folder is None else folder,
            images={
                topic: settings.image
                for topic, settings in job.topic_settings.items()
                if "image" in settings.model_fields_set
            },
            formats=job.adapters.serialization_formats,
            python=job.adapters.python,
        )

    def resolve(self, topic: str, msgtype: str) -> Resolution:
        """Return the adapter of a topic.

        Raises:
            AdapterError: The topic's override does not take the type.
        """
        resolution = self._resolve(topic, normalize_msgtype(msgtype))
        pattern = first_match(self._images, topic)
        if pattern is None or self._images[pattern].format == "raw":
            return resolution
        return replace(resolution, spec=EncodedImageSpec(resolution.spec, self._images[pattern]))

    def _resolve(self, topic: str, msgtype: str) -> Resolution:
        pattern = first_match(self._overrides, topic)
        if pattern is not None:
            return self._override(pattern, topic, msgtype)
        sources: tuple[tuple[Reason, Mapping[str, tuple[str, AdapterSpec]]], ...] = (
            ("loaded", self._loaded),
            ("registered", self._registered),
            ("entry point", self._installed),
        )
        for reason, by_type in sources:
            if msgtype in by_type:
                origin, spec = by_type[msgtype]
                return Resolution(spec, reason, origin)
        if msgtype in BY_TYPE:
            return Resolution(BY_TYPE[msgtype], "built-in", f"built-in for {msgtype}")
        layout = self._formats.get(msgtype, SerializationFormat.DEFAULT)
        why = f"no adapter takes {msgtype}; its messages keep their shape"
        return Resolution(UnmodeledSpec(serialization_format=layout), "unmodeled", why)

    def _override(self, pattern: str, topic: str, msgtype: str) -> Resolution:
        spec = self._overrides[pattern]
        if spec.ros_types and msgtype not in spec.ros_types:
            raise AdapterError(
                f"the override {pattern!r} names {spec.name}, which takes {', '.join(spec.ros_types)}; "
                f"the topic carries {msgtype}",
                where=topic,
                hint="name an adapter that takes this type, or exclude the topic from the override",
            )
        return Resolution(spec, "override", f"override {pattern!r}")

    @classmethod
    def get_default_adapter(cls, ros_msg_type: str) -> type[ROSAdapterBase[Any]] | None:
        """Return the class of the adapter that a message type gets without a job, None if there is none.

        None is also the result for an adapter file that an installed package offers, because it is not a class.
        """
        from mosaico_ingest.adapters.standalone import adapter_class  # noqa: PLC0415 - imports the ontology models

        spec = cls().resolve("", ros_msg_type).spec
        if isinstance(spec, PythonAdapterSpec):
            return spec.adapter
        return adapter_class(spec.name) if isinstance(spec, Builtin) else None

    @classmethod
    def is_msgtype_adapted(cls, ros_msg_type: str) -> bool:
        """Return whether a message type has an adapter without a job."""
        return not cls().resolve("", ros_msg_type).unmodeled

    @classmethod
    def from_ros_message(cls, msg: ROSMessage) -> Message:
        """Translate one message with the adapter that its type gets without a job.

        Raises:
            AdapterError: No adapter takes the type, or the message does not fit.
        """
        from mosaico_ingest.adapters.standalone import translate  # noqa: PLC0415 - a run has no single messages

        resolution = cls().resolve(msg.topic, msg.msg_type)
        if resolution.unmodeled:
            raise AdapterError(
                f"no adapter takes {msg.msg_type}",
                where=msg.topic,
                hint="register one with @register_default_adapter",
            )
        return translate(resolution.spec, msg)


def _layout(value: object) -> SerializationFormat:
    try:
        # The SDK has its own enumeration.
        return SerializationFormat(value.value if isinstance(value, Enum) else value)
    except ValueError:
        allowed = ", ".join(layout.value for layout in SerializationFormat)
        raise AdapterError(
            f"there is no serialization format {value!r}", hint=f"allowed: {allowed}"
        ) from None


def _by_type(specs: Iterable[tuple[str, AdapterSpec]]) -> dict[str, tuple[str, AdapterSpec]]:
    """Return default adapters by message type; two adapters for one type raise an error."""
    by_type: dict[str, tuple[str, AdapterSpec]] = {}
    for origin, spec in specs:
        for msgtype in spec.ros_types if spec.default else ():
            if msgtype in by_type and by_type[msgtype][1] != spec:
                other_origin, other = by_type[msgtype]
                raise AdapterError(
                    f"{other.name} ({other_origin}) and {spec.name} ({origin}) both take {msgtype}",
                    hint="remove one, or set `default: false` in it and select it with an override",
                )
            by_type[msgtype] = (origin, spec)
    return by_type


def _registered() -> dict[str, tuple[str, AdapterSpec]]:
    if not is_python_allowed():
        return {}
    return {
        msgtype: (f"registered by {adapter.__module__}", PythonAdapterSpec(adapter))
        for msgtype, adapter in registered_adapters().items()
    }


def installed_adapters() -> tuple[tuple[str, AdapterSpec], ...]:
    """Return the adapters of installed packages, each with the name of its entry point; empty if Python is refused.

    Raises:
        AdapterError: An entry point cannot be imported or is not an adapter; the error names the package.
    """
    return _entry_point_adapters() if is_python_allowed() else ()


@cache
def _entry_point_adapters() -> tuple[tuple[str, AdapterSpec], ...]:
    adapters: list[tuple[str, AdapterSpec]] = []
    for entry in entry_points(group=ENTRY_POINTS):
        package = entry.dist.name if entry.dist else "an installed package"
        try:
            offered = entry.load()
            offers = offered if isinstance(offered, (list, tuple)) else (offered,)
            specs = [adapter_spec(offer, Path()) for offer in offers]
        except Exception as error:
            raise AdapterError(
                f"entry point {entry.name} of {package} cannot be used: {type(error).__name__}: {error}",
                hint=f"repair or remove {package}",
            ) from error
        adapters += [(f"entry point {entry.name} of {package}", spec) for spec in specs]
    return tuple(adapters)
