"""This file is `ingest verify`: reads what is stored back and says whether it is what was written."""

from __future__ import annotations

from typing import Annotated

import typer

__all__ = ["verify"]


def verify(
    sequences: Annotated[
        list[str] | None, typer.Argument(metavar="SEQUENCE", help="Which ones; all without a name.")
    ] = None,
    store: Annotated[
        str, typer.Option("--store", help="The store's folder or URL.", metavar="DIR|URL")
    ] = "mosaico",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Read stored sequences back and hold every page and all rows against their checksums; exit 5 where they differ."""
    import json

    from mosaico_ingest.cli.collector import collect_as_usual
    from mosaico_ingest.cli.console import print_line
    from mosaico_ingest.cli.tables import print_json
    from mosaico_ingest.cli.without_pandas import forgo_pandas
    from mosaico_ingest.errors import VerificationError
    from mosaico_ingest.report.units import bytes_text, counted
    from mosaico_ingest.store import Store
    from mosaico_ingest.store.verify import verify as verify_sequence

    collect_as_usual()
    forgo_pandas()
    opened = Store.open(store, create=False)
    infos = [opened.sequence(name) for name in sequences] if sequences else opened.sequences()
    checked = {info.name: list(verify_sequence(info)) for info in infos}
    bad = [
        {"sequence": name, "topic": one.topic, "file": str(one.segment.path), "problem": one.problem}
        for name, found in checked.items()
        for one in found
        if one.problem is not None
    ]
    rows = sum(one.segment.rows for found in checked.values() for one in found)
    size = sum(one.segment.stored_bytes for found in checked.values() for one in found)
    if as_json:
        print_json(json.dumps({"sequences": list(checked), "rows": rows, "bytes": size, "problems": bad}))
    else:
        for one in bad:
            print_line(f"{one['sequence']}{one['topic']}: {one['file']}: {one['problem']}", stderr=True)
    if bad:
        raise VerificationError(
            f"{counted(len(bad), 'file')} not as written",
            where=store,
            hint="ingest their recordings again with if_exists: replace",
        )
    if not as_json:
        typer.echo(
            f"{counted(len(checked), 'sequence')}, {counted(rows, 'row')} in {bytes_text(size)}: all as written"
        )
