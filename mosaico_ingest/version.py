"""This file holds the version, alone, so that the build and `ingest --version` read it without imports."""

__version__ = "0.1.0"
