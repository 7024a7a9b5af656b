"""The command line: arguments in, calls of `mosaico_ingest.api`, terminal output and an exit code out.

One module holds one group of commands. Only this package may import typer and rich, and no other package may import it.
"""
