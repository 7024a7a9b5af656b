"""Definitions by name: those shipped with the package, those that users register, and those in recordings.

`distros.json` maps each type name to its forms (`.msg` text with full names) and the distros that use each form. It is
generated from the type stores of rosbags, because importing those at run time is slow.

`packages/` contains the fields of public packages; their licenses are listed in `packages/README.md`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from difflib import get_close_matches
from enum import Enum
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, ClassVar

from msgspec import Struct

from mosaico_ingest.documents import read_limited
from mosaico_ingest.errors import BagError, DefinitionError
from mosaico_ingest.findings import Finding, Severity, Span
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.linking import link
from mosaico_ingest.rosbag.definitions.model import (
    DURATION,
    PRIMITIVES,
    TIME,
    Definition,
    Embedded,
    Field,
    MessageType,
    RepeatedFieldError,
    Source,
    flatten,
    normalize_msgtype,
    parse_msg,
    read_types,
)

FILE = Path(__file__).with_name("distros.json")
_PARTS = (Field("sec", "int32"), Field("nanosec", "uint32"))
BUILTIN: Mapping[str, MessageType] = {name: MessageType(name, _PARTS) for name in (TIME, DURATION)}
"""The types that every distro has, and that ROS 1 calls `time` and `duration`."""
ROS1 = (Stores.ROS1_NOETIC,)
BEFORE_IRON = (
    Stores.ROS2_DASHING, Stores.ROS2_ELOQUENT, Stores.ROS2_FOXY, Stores.ROS2_GALACTIC, Stores.ROS2_HUMBLE,
)  # fmt: skip
"""The distros whose recordings contain no definitions."""
ROS2 = (*BEFORE_IRON, Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL)
_FOLDER = Path(__file__).parent / "packages"
_SUFFIXES = (".msg", ".idl")
CustomMessages = tuple[str, Path, Stores | str | None]
"""A package, the directory of its `.msg` files (or one file), and the distro that it applies to (None: all)."""
_PACKAGE = "the public package "
_OVERRIDE_HINT = "if your types have other fields, provide them with custom_msgs"
_UNSPECIFIED = frozenset({"unknown", ""})
_LANGUAGES = frozenset({"ros1msg", "ros2msg", "ros2idl", "omgidl", "idl", "msg"}) | _UNSPECIFIED


class Registered(Struct, frozen=True):
    """A registered or custom definition: its type, its text, and every type that the text defines."""

    msgtype: str
    text: str
    types: Mapping[str, MessageType]
    file: Path | None = None
    """The `.msg` or `.idl` file that contains the text, or None."""


class ROSTypeRegistry:
    """The message types registered in this process, for all distros or for one. All methods are class methods."""

    _scopes: ClassVar[dict[Stores | None, dict[str, Registered]]] = {}

    @classmethod
    def register(cls, msg_type: str, source: Path | str, store: Stores | str | None = None) -> None:
        """Register one type: `source` is its text, or the path of a `.msg` or `.idl` file. A later registration replaces it.

        Raises:
            BagError: The file or its text cannot be read; names the file and the line.
        """
        entry = register_source(msg_type, source)
        cls._scopes.setdefault(store_of(store), {})[entry.msgtype] = entry

    @classmethod
    def register_directory(
        cls, package_name: str, dir_path: Path | str, store: Stores | str | None = None
    ) -> None:
        """Register every `.msg` and `.idl` file of a directory as `<package_name>/msg/<file name>`.

        Raises:
            BagError: The directory does not exist or has no such files, or a file is invalid. No type is registered then.
        """
        entries = {entry.msgtype: entry for entry in directory_types(package_name, Path(dir_path))}
        cls._scopes.setdefault(store_of(store), {}).update(entries)

    @classmethod
    def get_types(cls, store: Stores | str | None = None) -> dict[str, str]:
        """Return the text of every registered type: those for all distros, overlaid by those for `store`."""
        return {name: entry.text for name, entry in cls.entries(store).items()}

    @classmethod
    def entries(cls, store: Stores | str | None = None) -> dict[str, Registered]:
        """Return the parsed definitions of the types that `get_types` returns."""
        scope = store_of(store)
        return {**cls._scopes.get(None, {}), **(cls._scopes.get(scope, {}) if scope else {})}

    @classmethod
    def snapshot(cls) -> dict[Stores | None, dict[str, Registered]]:
        """Return all registered types, for `restore` in another process."""
        return {scope: dict(entries) for scope, entries in cls._scopes.items()}

    @classmethod
    def restore(cls, snapshot: Mapping[Stores | None, Mapping[str, Registered]]) -> None:
        """Replace all registered types by those of a snapshot."""
        cls._scopes.clear()
        cls._scopes.update({scope: dict(entries) for scope, entries in snapshot.items()})

    @classmethod
    def reset(cls) -> None:
        """Remove all registered types."""
        cls._scopes.clear()


class TypeResolver:
    """Finds definitions: embedded in the recording, custom, registered, of the distro, of public packages, in this order.

    Nested types are searched individually in the same order. Without a distro, a standard type is used if all distros
    of the ROS version agree on its fields, with a finding. A resolver copies the registered types when it is created.
    """

    def __init__(
        self,
        distro: Stores | str | None = None,
        custom: Iterable[CustomMessages] = (),
        *,
        types: Mapping[str, Path | str] | None = None,
        registry: type[ROSTypeRegistry] = ROSTypeRegistry,
    ) -> None:
        """Parse the custom definitions: `custom` by package, `types` individually, as text or file.

        Raises:
            BagError: A definition is invalid.
        """
        store = store_of(distro)
        self.distro = None if store is Stores.EMPTY else store
        self._other_distros = dict[str, str]()
        own = list[Registered]()
        for package, path, only in custom:
            entries = list(directory_types(package, Path(path)))
            scope = store_of(only)
            if scope and self.distro and scope is not self.distro:
                self._other_distros |= {entry.msgtype: scope.value for entry in entries}
            else:
                own += entries
        own += [register_source(name, source) for name, source in (types or {}).items()]
        self.custom_texts: Mapping[str, str] = {entry.msgtype: entry.text for entry in own}
        """The custom definitions by type, as text."""
        self._custom = _by_name(own)
        self._registered = _by_name(registry.entries(self.distro).values())
        _check_local_types(own, {*self._custom, *self._registered, *self._other_distros})
        self._resolved = dict[tuple[str, Embedded | None, int], Definition]()
        self._assumed = dict[str, str]()
        self._replaced = dict[str, str]()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_resolved": {}}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The assumptions made so far."""
        return self.findings_about({*self._replaced, *self._assumed})

    def findings_about(self, types: AbstractSet[str]) -> tuple[Finding, ...]:
        """Return the findings about the given types."""
        findings = [
            Finding(
                "unreadable-definition", Severity.WARNING, f"{root}: the job's definition is used; {problem}"
            )
            for root, problem in self._replaced.items()
            if root in types
        ]
        assumed = {name: who for name, who in self._assumed.items() if name in types}
        for who in dict.fromkeys(assumed.values()):
            names = ", ".join(name for name, origin in assumed.items() if origin == who)
            message = f"the recording does not define these types; the definitions of {who} are used: {names}"
            remedy = (
                _OVERRIDE_HINT if who.startswith(_PACKAGE) else "set ros_distro to select the definitions"
            )
            findings.append(Finding("assumed-definition", Severity.INFO, message, help=remedy))
        return tuple(findings)

    def resolve(self, msgtype: str, embedded: Embedded | None, *, ros_version: int) -> Definition:
        """Return the definition of `msgtype`, in any notation of the name.

        Raises:
            BagError: The type or a nested type is unknown, or the embedded definition is invalid.
        """
        key = (msgtype, embedded, ros_version)
        if key not in self._resolved:
            self._resolved[key] = self._resolve(normalize_msgtype(msgtype), embedded, ros_version)
        return self._resolved[key]

    def _resolve(self, root: str, embedded: Embedded | None, version: int) -> Definition:
        if embedded is not None and not (self._custom or self._registered or self.distro):
            definition = _complete_definition(root, embedded, version)
            if definition is not None:
                return definition
        sources = self._sources(root, embedded, version)
        entry = next(
            ((message, candidate.source) for candidate in sources if (message := candidate.find(root))), None
        )
        hint = self._hint(sources, version)
        if not entry:
            elsewhere = self._other_distros.get(root)
            limited = f"; custom_msgs has it for {elsewhere} only" if elsewhere else ""
            raise BagError(f"the definition of {root} is not known{limited}", hint=hint)
        message, source = entry

        def find(name: str) -> MessageType | None:
            messages = (candidate.find(name) for candidate in sources)
            return next((message for message in messages if message), BUILTIN.get(name))

        types = link(message, find, ros_version=version, hint=hint)
        return Definition(root, types, source, flatten(root, types, ros_version=version), version)

    def _sources(self, root: str, embedded: Embedded | None, version: int) -> list[_TypeSource]:
        sources = [
            _TypeSource("the recording", Source.BAG, self._embedded(root, embedded).get),
            _TypeSource("custom_msgs", Source.CUSTOM, self._custom.get),
            _TypeSource("the type registry", Source.CUSTOM, self._registered.get),
        ]
        distro = self.distro
        if distro is None:
            sources += self._agreements(embedded, version)
        elif ros_version(distro) == version:
            sources.append(_TypeSource(distro.value, Source.DISTRO, lambda name: distro_type(distro, name)))
        if version == 2:  # noqa: PLR2004 - a ROS 1 recording always has definitions
            sources.append(_TypeSource("the packages this tool knows", Source.PACKAGE, self._package))
        if embedded and embedded.encoding not in _UNSPECIFIED and _is_empty(embedded.text):
            # An empty text is a type without fields, unless a distro has the type: recorders without the definition
            # write an empty text, or a comment.
            is_public = any(distro_type(distro, root) for distro in (ROS1 if version == 1 else ROS2))
            empty = {} if is_public else {root: MessageType(root, ())}
            sources.append(_TypeSource("the recording's empty text", Source.BAG, empty.get))
        return sources

    def _embedded(self, root: str, embedded: Embedded | None) -> Mapping[str, MessageType]:
        if embedded is None or _is_empty(embedded.text):
            return {}
        if embedded.encoding.lower() not in _LANGUAGES:
            raise BagError(f"a schema in {embedded.encoding!r} is not a ROS definition", where=root)
        try:
            return read_types(embedded.text, root)
        except BagError as error:
            if root not in self._custom and root not in self._registered:
                problem = f"the definition in the recording is invalid: {error.what}"
                raise BagError(
                    problem, where=error.where, hint="provide the type with custom_msgs"
                ) from error
            self._replaced[root] = error.what
            return {}

    def _agreements(self, embedded: Embedded | None, version: int) -> list[_TypeSource]:
        """Return the sources without a distro. A recording without definitions is older than ROS 2 Iron."""
        sources = [self._agreement(f"all ROS {version} distros", ROS1 if version == 1 else ROS2)]
        if embedded is None and version != 1:
            sources.append(
                self._agreement("all distros until Humble, the last to record no definitions", BEFORE_IRON)
            )
        return sources

    def _agreement(self, who: str, distros: tuple[Stores, ...]) -> _TypeSource:
        def find(name: str) -> MessageType | None:
            if name in BUILTIN:
                return BUILTIN[name]  # embedded texts never define them; loading the distros is slow
            message = agreed_type(name, distros)
            if message and message.fields:  # a type without fields needs no assumption
                self._assumed.setdefault(name, who)
            return message

        return _TypeSource(f"what {who.partition(',')[0]} agree on", Source.DISTRO, find)

    def _package(self, name: str) -> MessageType | None:
        message = package_type(name)
        if message:
            self._assumed.setdefault(name, f"{_PACKAGE}{name.partition('/')[0]}")
        return message

    def _hint(self, sources: list[_TypeSource], version: int) -> str:
        searched = f"searched: {', '.join(candidate.label for candidate in sources)}"
        if self.distro and ros_version(self.distro) != version:
            return f"{searched}; the recording is ROS {version}, ros_distro is {self.distro.value}; set the right one"
        remedy = (
            "provide it with custom_msgs" if self.distro else "set ros_distro, or provide it with custom_msgs"
        )
        return f"{searched}; {remedy}"


def ros_version(distro: Stores) -> int | None:
    """Return the ROS version of a distro, 1 or 2; None for `Stores.EMPTY`."""
    if distro is Stores.EMPTY:
        return None
    return 1 if distro.value.startswith("ros1") else 2


def distro_type(distro: Stores, name: str) -> MessageType | None:
    """Return a distro's type by full name, None if the distro does not have it."""
    forms = _distro_types().get(name, {})
    text = next((text for having, text in forms.items() if distro.value in having.split()), None)
    return None if text is None else _form(name, text)


@lru_cache(maxsize=4096)
def agreed_type(name: str, distros: tuple[Stores, ...]) -> MessageType | None:
    """Return the newest form of a type if all distros that have it agree on its fields, else None."""
    forms = [form for distro in distros if (form := distro_type(distro, name))]
    return forms[-1] if forms and all(form.fields == forms[0].fields for form in forms) else None


def package_type(name: str) -> MessageType | None:
    """Return a ROS 2 type of a public package by full name, None if no shipped package has it."""
    return _types(name.partition("/")[0]).get(name)


def distro_definitions(msgtype: str, ros_version: int) -> tuple[tuple[str, Definition], ...]:
    """Return the distinct definitions of a type in the distros of a ROS version, each with the newest distro that has it."""
    definitions = dict[str, tuple[str, Definition]]()
    for distro in ROS1 if ros_version == 1 else ROS2:
        root = distro_type(distro, msgtype)
        if root:
            types = link(
                root,
                lambda name, distro=distro: distro_type(distro, name) or BUILTIN.get(name),
                ros_version=ros_version,
                hint="",
            )
            text = flatten(msgtype, types, ros_version=ros_version)
            definitions[text] = distro.value, Definition(msgtype, types, Source.DISTRO, text, ros_version)
    return tuple(definitions.values())


def store_of(store: Stores | str | None) -> Stores | None:
    """Return the distro with a name.

    Raises:
        BagError: The distro is unknown; the hint names the nearest.
    """
    if store is None:
        return None
    try:
        # members of the enumeration of rosbags are accepted too
        return Stores(store.value if isinstance(store, Enum) else store)
    except ValueError:
        names = [distro.value for distro in Stores]
        near = get_close_matches(str(store), names, n=1)
        hint = f"did you mean {near[0]}?" if near else f"the distros are {', '.join(names)}"
        raise BagError(f"unknown distro {store!r}", hint=hint) from None


def register_source(msg_type: str, source: Path | str) -> Registered:
    """Parse one definition, from a file or text.

    Raises:
        BagError: The file cannot be read, or its text is invalid.
    """
    name = normalize_msgtype(msg_type)
    if name.count("/") != 2:  # noqa: PLR2004 - pkg/msg/Name
        raise BagError(f"{msg_type!r} is not the name of a message type", hint="write it as pkg/msg/Name")
    text, where = (source, f"definition of {name}") if _is_text(source) else _read(Path(source))
    file = None if _is_text(source) else Path(source)
    try:
        types = dict(read_types(str(text), name, where=where))
    except BagError as error:
        raise error if file is None else _syntax_error(error, file, str(text)) from error
    if name not in types:
        raise BagError(f"the text does not define {name}", where=where, hint=f"it defines {', '.join(types)}")
    return Registered(name, str(text), types, file)


def suggest_type(msgtype: str) -> str:
    """Return a hint for a field type that is not defined."""
    near = get_close_matches(msgtype, PRIMITIVES, n=1, cutoff=0.7)
    if near:
        return f"did you mean {near[0]}?"
    return "define it under bag.custom_msgs" if "/" in msgtype else "put its .msg file next to this one"


def directory_types(package: str, path: Path) -> Iterator[Registered]:
    """Parse the definitions of a package: the files in a directory or its `msg` folder, or a single file.

    Raises:
        BagError: There are no files, or one is invalid.
    """
    files = definition_files(path)
    if not files:
        there = "has no .msg or .idl file" if path.is_dir() else "does not exist"
        raise BagError(
            f"{path} {there}",
            where=f"messages of {package}",
            hint="name a directory with .msg files, or one file",
        )
    for file in files:
        yield register_source(f"{package.removesuffix('/msg')}/msg/{file.stem}", file)


def definition_files(path: Path) -> list[Path]:
    """Return the definition files in a directory or its `msg` folder, or the file itself."""
    if path.is_file():
        return [path]
    for folder in (path, path / "msg"):
        if folder.is_dir():
            files = sorted(file for file in folder.iterdir() if file.suffix in _SUFFIXES)
            if files:
                return files
    return []


@cache
def _distro_types() -> Mapping[str, Mapping[str, str]]:
    return json.loads(FILE.read_bytes())


@cache
def _form(name: str, text: str) -> MessageType:
    return parse_msg(text, name)


@cache
def _package_names() -> frozenset[str]:
    return frozenset(path.stem for path in _FOLDER.glob("*.txt"))


@cache
def _types(package: str) -> Mapping[str, MessageType]:
    if package not in _package_names():
        return {}
    path = _FOLDER / f"{package}.txt"
    return read_types(path.read_text(encoding="utf-8"), package, where=str(path))


def _syntax_error(error: BagError, file: Path, text: str) -> BagError:
    """Return the error with a finding at its line of a definition file."""
    line = (error.where or "").rpartition(":")[2]
    if not line.isdigit():
        return error
    span = Span(str(file), int(line), 1, int(line), 1)
    rule = "msg-syntax"
    if isinstance(error, RepeatedFieldError):
        rule = "msg-repeated-name"
        declaration = re.search(rf"\s({re.escape(error.name)})\b", text.split("\n")[int(line) - 1])
        column = declaration.start(1) + 1 if declaration else 1
        span = Span(str(file), int(line), column, int(line), column + len(error.name))
    finding = Finding(rule, Severity.ERROR, error.what, span, error.hint)
    return DefinitionError(error.what, where=str(span), hint=error.hint, findings=(finding,))


def _check_local_types(own: Sequence[Registered], public_names: Container[str]) -> None:
    """Check that every field type without a package, which can only be in the same package, is defined.

    Raises:
        DefinitionError: A type is not defined; names the file and the line.
    """
    for entry in own:
        package = entry.msgtype.partition("/")[0]
        names = (
            (field.name, field.type)
            for message in entry.types.values()
            for field in message.fields
            if field.is_message and "/" not in field.type and field.type != "Header"
        )
        for name, msgtype in names:
            if entry.file is not None and f"{package}/msg/{msgtype}" not in public_names:
                raise _unknown_type(entry, entry.file, name, msgtype)


def _unknown_type(entry: Registered, file: Path, name: str, msgtype: str) -> DefinitionError:
    declaration = re.compile(rf"\s*(?P<type>{re.escape(msgtype)})\b.*\s{re.escape(name)}\b")
    matches = enumerate(map(declaration.match, entry.text.splitlines()), 1)
    line, column = next(((line, match.start("type") + 1) for line, match in matches if match), (1, 1))
    span = Span(str(file), line, column, line, column + len(msgtype))
    message, hint = f"the type {msgtype!r} is not defined", suggest_type(msgtype)
    finding = Finding("msg-unknown-type", Severity.ERROR, message, span, hint)
    return DefinitionError(message, where=str(span), hint=hint, findings=(finding,))


def _is_text(source: Path | str) -> bool:
    """Return whether a source is a definition. A single line that ends with `.msg` or `.idl` is a path."""
    if isinstance(source, Path) or not source.endswith(_SUFFIXES) or "\n" in source:
        return isinstance(source, str)
    return len(source.split()) > 1 and not Path(source).is_file()


def _read(path: Path) -> tuple[str, str]:
    try:
        return read_limited(path).decode("utf-8-sig"), str(path)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise BagError(f"cannot read the definition: {reason}", where=str(path)) from error


class _TypeSource(Struct, frozen=True):
    """One of the sources that are searched for types."""

    label: str
    source: Source
    find: Callable[[str], MessageType | None]


@lru_cache(maxsize=1024)
def _complete_definition(root: str, embedded: Embedded, version: int) -> Definition | None:
    """Return the definition in an embedded text that defines all nested types, None for any other text.

    The recordings of a fleet embed the same texts. They share one definition, so that its shape is computed once, too.
    """
    if embedded.encoding.lower() not in _LANGUAGES or _is_empty(embedded.text):
        return None
    try:
        named = {**BUILTIN, **read_types(embedded.text, root)}
        types = link(named[root], named.get, ros_version=version, hint="")
    except (BagError, KeyError):
        return None
    return Definition(root, types, Source.BAG, flatten(root, types, ros_version=version), version)


def _is_empty(text: str) -> bool:
    return all(not line.strip() or line.lstrip().startswith("#") for line in text.split("\n"))


def _by_name(entries: Iterable[Registered]) -> dict[str, MessageType]:
    """Return all types by name; a definition of its own takes precedence over one nested in another text."""
    selection = list(entries)
    types = {name: message for entry in reversed(selection) for name, message in entry.types.items()}
    return types | {entry.msgtype: entry.types[entry.msgtype] for entry in selection}
