"""`function-arguments`: a function called with the wrong arguments.

How many arguments a function takes, and of which kind, is part of its name's meaning.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: sqrt(temperature, 2)

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

RULE = Rule("ING406", __name__, Severity.ERROR, __doc__)
