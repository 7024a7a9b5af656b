"""`yaml-anchor`: an anchor that hides another of the same name.

An alias takes the last anchor above it. Two of one name make its value depend on the order of the lines.

Bad:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu: &often {every: 3}
      /odom: &often {every: 5}
      /gps: *often

Good:
    bag: {path: data/run.mcap}
    topic_settings:
      /imu: &often {every: 3}
      /odom: {every: 5}
      /gps: *often
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING005", __name__, Severity.ERROR, __doc__)
