"""The registry of destinations: the store, the server, and the destinations of installed packages.

A package adds a destination with an entry point of the group `mosaico_ingest.destinations`:

    [project.entry-points."mosaico_ingest.destinations"]
    lake = "my_package.lake:open_lake"

The name selects it in a manifest (`target: {type: lake, options: {…}}`). The object is called with the options, a
mapping, and the folder of the manifest, and returns a `Destination`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, TypeAlias

from mosaico_ingest.destinations.base import Destination
from mosaico_ingest.errors import IngestError, ManifestError, SinkError
from mosaico_ingest.findings import suggest_names
from mosaico_ingest.job.values import PluginTarget, ServerTarget, StoreTarget, Target

ENTRY_POINTS = "mosaico_ingest.destinations"

DestinationFactory: TypeAlias = Callable[[Mapping[str, Any], Path], Destination]
"""Creates a destination from the options of a manifest and the manifest's folder."""
KeepOpen: TypeAlias = Callable[[Target], None]


def destination_of(target: Target) -> Destination:
    """Return the destination that a target selects.

    Raises:
        ManifestError: No installed package provides this type of destination, or it rejects the options.
    """
    return _FACTORIES.get(target.kind, _plugin)(target)


@contextmanager
def keep_destinations_open() -> Generator[KeepOpen]:
    """Yield a function that keeps a target open until the context ends.

    A batch of recordings uses it because closing a SQLite catalog for the last time costs a checkpoint.
    """
    locations: set[tuple[str, str]] = set()
    with ExitStack() as stack:

        def keep(target: Target) -> None:
            with suppress(IngestError):  # opening the destination for the run reports the error
                destination = destination_of(target)
                location = (destination.kind, destination.describe())
                context = None if location in locations else destination.keep_open()
                if context is not None:
                    stack.enter_context(context)
                    locations.add(location)

        yield keep


def _store(target: StoreTarget) -> Destination:
    from mosaico_ingest.destinations.store.destination import StoreDestination  # noqa: PLC0415 - Parquet is slow to import

    return StoreDestination(target.path, target.compression)


def _server(target: ServerTarget) -> Destination:
    from mosaico_ingest.destinations.server.destination import ServerDestination  # noqa: PLC0415 - Flight is slow to import

    return ServerDestination(target)


def _plugin(target: PluginTarget) -> Destination:
    factories = {entry.name: entry for entry in entry_points(group=ENTRY_POINTS)}
    if target.kind not in factories:
        raise ManifestError(
            f"no destination of type {target.kind!r} is installed",
            where="target.type",
            hint=suggest_names(factories, [target.kind]) or "install the package that provides it",
        )
    try:
        factory: DestinationFactory = factories[target.kind].load()
        return factory(target.options, target.base_dir)
    except IngestError:
        raise
    except Exception as error:
        raise SinkError(
            f"the destination {target.kind!r} cannot be created: {type(error).__name__}: {error}",
            where=factories[target.kind].value,
            hint="check target.options and the package that provides the destination",
        ) from error


_FACTORIES: Mapping[str, Callable[[Any], Destination]] = {
    StoreTarget.kind: _store,
    ServerTarget.kind: _server,
}
