"""The `ingest` command as `python -m mosaico_ingest`."""

from mosaico_ingest.cli.app import main

if __name__ == "__main__":
    main()
