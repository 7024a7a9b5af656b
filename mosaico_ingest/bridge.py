"""This file decides which adapter a topic gets, and says why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from enum import Enum
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mosaico_ingest.adapters.adapter import AdapterSpec
from mosaico_ingest.adapters.base import registered_adapters
from mosaico_ingest.adapters.builtin import BY_TYPE
from mosaico_ingest.adapters.image import PngImageSpec
from mosaico_ingest.adapters.python_adapter import PythonAdapterSpec
from mosaico_ingest.adapters.reference import adapter_spec
from mosaico_ingest.adapters.unmodeled import UnmodeledSpec
from mosaico_ingest.bag.names import normalize_msgtype
from mosaico_ingest.config import AdapterReference, ImageFormat, ROSInjectionConfig
from mosaico_ingest.errors import AdapterError
from mosaico_ingest.frozen import frozen
from mosaico_ingest.ontology.types import SerializationFormat
from mosaico_ingest.patterns import first_match

if TYPE_CHECKING:
    from mosaico_ingest.bag.message import ROSMessage
    from mosaico_ingest.ontology.message import Message

__all__ = ["ENTRY_POINTS", "ROSBridge", "Reason", "Resolution", "installed_adapters"]

ENTRY_POINTS = "mosaico_ingest.adapters"
"""The group under which an installed package names its adapters: a class, a spec, or a list of them."""

Reason = Literal["override", "loaded", "registered", "entry point", "built-in", "unmodeled"]


@frozen
class Resolution:
    """The adapter of a topic and which rule chose it; the first of the reasons that applies does."""

    spec: AdapterSpec
    reason: Reason
    why: str

    @property
    def unmodeled(self) -> bool:
        """Whether no adapter takes the type."""
        return self.reason == "unmodeled"


class ROSBridge:
    """Every adapter a run knows: its overrides by topic, its own by type, those installed, the built-in ones."""

    def __init__(
        self,
        *,
        overrides: Mapping[str, AdapterReference] | None = None,
        loaded: Iterable[AdapterReference] = (),
        base_dir: Path | None = None,
        images: Mapping[str, ImageFormat] | None = None,
        formats: Mapping[str, str] | None = None,
    ) -> None:
        """Find every adapter that is named; `base_dir` is where relative paths start.

        `overrides` and `images` are by topic name or glob, `formats` (of types without an adapter) by type.

        Raises:
            AdapterError: One is not there, has a mistake, or two are loaded for one type.
        """
        folder = base_dir or Path()
        own = [(str(reference), adapter_spec(reference, folder)) for reference in loaded]
        self._loaded = _by_type((f"loaded from {origin}", spec) for origin, spec in own)
        self._installed = _by_type(installed_adapters())
        names = {spec.name: spec for _, spec in (*installed_adapters(), *own)}
        self._overrides = {
            pattern: names.get(reference) or adapter_spec(reference, folder)
            if isinstance(reference, str)
            else adapter_spec(reference, folder)
            for pattern, reference in (overrides or {}).items()
        }
        self._images = dict(images or {})
        self._formats = {normalize_msgtype(name): _layout(value) for name, value in (formats or {}).items()}

    @classmethod
    def for_config(cls, config: ROSInjectionConfig) -> ROSBridge:
        """Make the bridge of a job.

        Raises:
            AdapterError: As when it is made by hand.
        """
        return cls(
            overrides=config.adapter_override,
            loaded=config.adapters,
            base_dir=config.code_dir or config.base_dir,
            images=config.images,
            formats=config.serialization_formats,
        )

    def resolve(self, topic: str, msgtype: str) -> Resolution:
        """Choose the adapter of a topic.

        Raises:
            AdapterError: The topic's override does not take the type.
        """
        found = self._resolve(topic, normalize_msgtype(msgtype))
        pattern = first_match(self._images, topic)
        if pattern is None or self._images[pattern] == "raw":
            return found
        return replace(found, spec=PngImageSpec(found.spec))

    def _resolve(self, topic: str, msgtype: str) -> Resolution:
        pattern = first_match(self._overrides, topic)
        if pattern is not None:
            return self._override(pattern, topic, msgtype)
        sources: tuple[tuple[Reason, Mapping[str, tuple[str, AdapterSpec]]], ...] = (
            ("loaded", self._loaded),
            ("registered", _registered()),
            ("entry point", self._installed),
        )
        for reason, by_type in sources:
            if msgtype in by_type:
                origin, spec = by_type[msgtype]
                return Resolution(spec, reason, origin)
        if msgtype in BY_TYPE:
            return Resolution(BY_TYPE[msgtype], "built-in", f"built-in for {msgtype}")
        layout = self._formats.get(msgtype, SerializationFormat.DEFAULT)
        why = f"no adapter takes {msgtype}; it keeps its ROS shape"
        return Resolution(UnmodeledSpec(serialization_format=layout), "unmodeled", why)

    def _override(self, pattern: str, topic: str, msgtype: str) -> Resolution:
        spec = self._overrides[pattern]
        if spec.ros_types and msgtype not in spec.ros_types:
            raise AdapterError(
                f"the override {pattern!r} names {spec.name}, which takes {', '.join(spec.ros_types)}; "
                f"the topic carries {msgtype}",
                where=topic,
                hint="name an adapter that takes this type, or leave the topic out of the override",
            )
        return Resolution(spec, "override", f"override {pattern!r}")

    @classmethod
    def from_ros_message(cls, msg: ROSMessage) -> Message:
        """Translate one message with the adapter its type gets without a job.

        Raises:
            AdapterError: No adapter takes the type, or the message does not fit.
        """
        from mosaico_ingest.adapters.single import translate  # noqa: PLC0415 - a run has no single messages

        found = cls().resolve(msg.topic, msg.msg_type)
        if found.unmodeled:
            raise AdapterError(
                f"no adapter takes {msg.msg_type}",
                where=msg.topic,
                hint="register one with @register_default_adapter",
            )
        return translate(found.spec, msg)


def _layout(said: object) -> SerializationFormat:
    try:
        return SerializationFormat(said.value if isinstance(said, Enum) else said)  # the SDK has its own
    except ValueError:
        allowed = ", ".join(layout.value for layout in SerializationFormat)
        raise AdapterError(f"there is no serialization format {said!r}", hint=f"allowed: {allowed}") from None


def _by_type(specs: Iterable[tuple[str, AdapterSpec]]) -> dict[str, tuple[str, AdapterSpec]]:
    """Arrange default adapters by message type; two for one type are a mistake."""
    by_type: dict[str, tuple[str, AdapterSpec]] = {}
    for origin, spec in specs:
        for msgtype in spec.ros_types if spec.default else ():
            if msgtype in by_type and by_type[msgtype][1] != spec:
                other_origin, other = by_type[msgtype]
                raise AdapterError(
                    f"{other.name} ({other_origin}) and {spec.name} ({origin}) both take {msgtype}",
                    hint="drop one, or give it `default: false` and name it in an override",
                )
            by_type[msgtype] = (origin, spec)
    return by_type


def _registered() -> dict[str, tuple[str, AdapterSpec]]:
    return {
        msgtype: (f"registered by {adapter.__module__}", PythonAdapterSpec(adapter))
        for msgtype, adapter in registered_adapters().items()
    }


@cache
def installed_adapters() -> tuple[tuple[str, AdapterSpec], ...]:
    """Return what installed packages offer, with where it comes from.

    Raises:
        AdapterError: One of them cannot be imported or is no adapter; names the package.
    """
    found: list[tuple[str, AdapterSpec]] = []
    for entry in entry_points(group=ENTRY_POINTS):
        package = entry.dist.name if entry.dist else "an installed package"
        try:
            offered = entry.load()
            offers = offered if isinstance(offered, (list, tuple)) else (offered,)
            specs = [adapter_spec(one, Path()) for one in offers]
        except Exception as error:
            raise AdapterError(
                f"entry point {entry.name} of {package} cannot be used: {type(error).__name__}: {error}",
                hint=f"repair or remove {package}",
            ) from error
        found += [(f"entry point {entry.name} of {package}", spec) for spec in specs]
    return tuple(found)
