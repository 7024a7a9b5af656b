"""`ingest store compact`."""

from __future__ import annotations

from typing import Annotated

import typer

from mosaico_ingest.cli.console import print_json, print_line
from mosaico_ingest.cli.options import DEFAULT_STORE, JsonOption, StoreOption
from mosaico_ingest.job.values import Compression
from mosaico_ingest.report.units import bytes_text, counted


def compact(
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="Sequences to compact; all if omitted.")
    ] = None,
    compression: Annotated[
        Compression, typer.Option("--compression", help="Compression of the merged files.")
    ] = Compression.FAST,
    store: StoreOption = DEFAULT_STORE,
    as_json: JsonOption = False,
) -> None:
    """Merge the small files of sequences that many sessions wrote. Readers and writers can continue meanwhile.

    The replaced files stay for programs that opened them earlier; `ingest store gc` removes them. Incomplete
    sequences stay unchanged.

    Exit codes: 0 done, 5 a file is damaged.
    """
    from mosaico_ingest.destinations.store import Store
    from mosaico_ingest.destinations.store.compaction import compact as compact_sequence
    from mosaico_ingest.errors import VerificationError

    opened = Store.open(store, create=False)
    results: list[dict[str, object]] = []
    replaced, damaged = 0, 0
    for name in sequences or opened.names():
        info = opened.sequence(name) if sequences else opened.find_sequence(name)
        if info is None or info.incomplete is not None:
            continue
        for result in compact_sequence(opened, info, compression=compression):
            where = f"{name}{result.topic}"
            results.append(
                {
                    "sequence": name,
                    "topic": result.topic,
                    "files": result.segments,
                    "bytes_before": result.bytes_before,
                    "bytes_after": result.bytes_after,
                    "problem": result.problem,
                }
            )
            if result.problem is not None:
                damaged += result.is_damaged
                print_line(f"{where}: not compacted: {result.problem}", stderr=True)
                continue
            replaced += result.segments
            if not as_json:
                sizes = f"{bytes_text(result.bytes_before)} -> {bytes_text(result.bytes_after)}"
                print_line(f"{where}: {result.segments} files -> 1, {sizes}")
    if as_json:
        print_json(results)
    elif replaced:
        print_line(f"`ingest store gc` removes the {counted(replaced, 'replaced file')}")
    else:
        print_line("nothing to compact")
    if damaged:
        raise VerificationError(
            f"damaged: {counted(damaged, 'run')} of files",
            where=store,
            hint="run `ingest verify`, and ingest their recordings again with if_exists: replace",
        )
