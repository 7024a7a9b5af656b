"""`unknown-field`: a field that the message does not have.

The names in an expression are fields of the message, or of what `of` names; which there are is known from the
definition of the message.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: temprature

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

RULE = Rule("ING401", __name__, Severity.ERROR, __doc__)
