"""`unknown-key`: a key that means nothing here.

An unknown key is a misspelt one, or one in the wrong section: what it asks for would silently not be done.

Bad:
    bag: {path: data/run.mcap, ros_distr: ros2_humble}

Good:
    bag: {path: data/run.mcap, ros_distro: ros2_humble}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING104", __name__, Severity.ERROR, __doc__)
