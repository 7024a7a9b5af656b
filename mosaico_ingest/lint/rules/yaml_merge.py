"""`yaml-merge`: a `<<` that merges no mapping.

`<<` takes over the keys of a mapping, or of a list of mappings. Of anything else there is nothing to take.

Bad:
    bag:
      path: data/run.mcap
      <<: ros2_humble

Good:
    bag:
      path: data/run.mcap
      <<: {ros_distro: ros2_humble}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING010", __name__, Severity.ERROR, __doc__)
