"""`ingest ontology`: list ontology types and show their fields."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.text import Text

from mosaico_ingest.cli.console import PlainTable, Terminal, print_json, print_line
from mosaico_ingest.cli.options import JsonOption

ontology_app = typer.Typer(no_args_is_help=True, help="List ontology types and show their fields.")


@ontology_app.command("ls")
def list_types(
    tag: Annotated[
        str | None, typer.Argument(metavar="GLOB", help="Only types whose tag matches, such as *Image.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the ontology types with the built-in adapters that produce them."""
    from msgspec import to_builtins

    from mosaico_ingest.errors import NothingMatched
    from mosaico_ingest.services.schemas import known_ontologies

    types = known_ontologies(tag)
    if not types:
        raise NothingMatched(
            f"no ontology type matches {tag!r}", hint="list all types with `ingest ontology ls`"
        )
    if as_json:
        print_json([to_builtins(one) for one in types])
        return
    table = PlainTable("tag", "fields", "description", "adapters", numbers={"fields"})
    for one in types:
        table.add_row(one.tag, str(one.fields), one.summary, ", ".join(one.adapters))
    Terminal().print(table)


@ontology_app.command()
def show(
    tag: Annotated[str, typer.Argument(metavar="TAG", help="The tag of an ontology type, such as IMU.")],
    as_json: JsonOption = False,
) -> None:
    """Show the fields of an ontology type with their types, units, and whether they can be null."""
    from msgspec import to_builtins

    from mosaico_ingest.services.schemas import describe_ontology

    described = describe_ontology(tag)
    if as_json:
        print_json(to_builtins(described))
        return
    Terminal(soft_wrap=True).print(Text.assemble((described.tag, "bold"), f": {described.summary}"))
    print_line(f"format {described.format}, fingerprint {described.fingerprint}", style="dim")
    table = PlainTable("field", "type", "unit", "")
    for field in described.fields:
        table.add_row(field.name, field.type, field.unit, "nullable" if field.nullable else "required")
    Terminal().print(table)
    if described.adapters:
        print_line(f"produced by {', '.join(described.adapters)}")
