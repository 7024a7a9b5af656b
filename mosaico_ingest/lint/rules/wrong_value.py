"""`wrong-value`: a value that is not allowed.

The key has a fixed set of words, a range, or a small language of its own, and the value is outside of it.

Bad:
    bag: {path: data/run.mcap, ros_distro: humble}

Good:
    bag: {path: data/run.mcap, ros_distro: ros2_humble}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING106", __name__, Severity.ERROR, __doc__)
