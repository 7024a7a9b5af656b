"""This file makes `python -m mosaico_ingest` the `ingest` command."""

from mosaico_ingest.cli.app import main

if __name__ == "__main__":
    main()
