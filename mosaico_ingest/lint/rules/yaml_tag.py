"""`yaml-tag`: an unquoted `!`, which starts a YAML tag.

`!/cam/debug` is read as a tag without a value, so the pattern is lost. Tags mean nothing in these files.

Bad:
    bag: {path: data/run.mcap}
    topics:
      - /cam/*
      - !/cam/debug

Good:
    bag: {path: data/run.mcap}
    topics:
      - /cam/*
      - "!/cam/debug"
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING003", __name__, Severity.ERROR, __doc__)
