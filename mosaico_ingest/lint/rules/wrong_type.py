"""`wrong-type`: a value of the wrong type.

A text where a list belongs, a number where a text belongs: guessing what was meant would guess wrong some day.

Bad:
    bag: {path: data/run.mcap}
    topics: /imu

Good:
    bag: {path: data/run.mcap}
    topics: [/imu]
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING105", __name__, Severity.ERROR, __doc__)
