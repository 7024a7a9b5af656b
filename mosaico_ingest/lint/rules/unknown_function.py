"""`unknown-function`: a function that does not exist.

The functions of the mapping language are listed in docs/mapping.md; they are not Python's.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: sqr(temperature)

Good:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: sqrt(temperature)
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING405", __name__, Severity.ERROR, __doc__)
