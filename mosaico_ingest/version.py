"""The version, in a module without imports, so that the build and `ingest --version` read it quickly."""

__version__ = "0.1.0"
