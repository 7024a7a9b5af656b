"""Shell completion of distros, sequences, topics, adapters, tags and rules; Typer completes commands, options and formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from mosaico_ingest.errors import IngestError

MAX_NAMES = 500
"""Maximum number of proposals."""


def completer(metavar: str | None) -> Callable[[Any, Any, str], list[str]] | None:
    """Return the function that completes values with this metavar, or None."""
    source = _SOURCES.get(metavar or "")
    if source is None:
        return None

    def complete(context: Any, _parameter: Any, incomplete: str) -> list[str]:  # noqa: ANN401 - classes of typer or click
        try:
            names = source(str(context.params.get("store") or "mosaico"), incomplete)
            return sorted(name for name in names if name.startswith(incomplete))[:MAX_NAMES]
        except (IngestError, OSError):
            return []  # without a store there is nothing to propose

    return complete


def _distros(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.job.values import Stores

    return (each.value for each in Stores if each.value.startswith("ros"))


def _sequences(store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.destinations.store import Store

    return Store.open(store, create=False).names()


def _topics(store: str, incomplete: str) -> Iterable[str]:
    """Return the sequences, followed by a slash, or the topics of the sequence before the slash."""
    from mosaico_ingest.destinations.store import Store

    opened = Store.open(store, create=False)
    sequence, slash, _ = incomplete.partition("/")
    if not slash:
        return (f"{name}/" for name in opened.names())
    return (f"{sequence}{topic.name}" for topic in opened.sequence(sequence).topics)


def _adapters(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.adapters.builtin import BY_NAME

    return BY_NAME


def _tags(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.ontology.registry import tags

    return tags()


def _rules(_store: str, _incomplete: str) -> Iterable[str]:
    from mosaico_ingest.rules import RULES

    return (*RULES, "all")


_SOURCES: dict[str, Callable[[str, str], Iterable[str]]] = {
    "DISTRO": _distros,
    "SEQUENCE": _sequences,
    "JOB.yaml|SEQUENCE": _sequences,
    "SEQUENCE/TOPIC": _topics,
    "SEQUENCE[/TOPIC]": _topics,
    "NAME|FILE": _adapters,
    "NAME|TYPE|FILE": _adapters,
    "TAG": _tags,
    "RULE": _rules,
}
"""The proposals by metavar; the arguments are the store and the incomplete word."""
