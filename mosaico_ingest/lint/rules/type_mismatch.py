"""`type-mismatch`: a value that does not fit its column.

A struct for a number, a scalar for a list, a number that would lose digits without `cast()`.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: header

Good:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: temperature
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING409", __name__, Severity.ERROR, __doc__)
