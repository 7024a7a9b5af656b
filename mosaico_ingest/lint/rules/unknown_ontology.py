"""`unknown-ontology`: an ontology that does not exist.

`ontology` is the tag of a known record, or `{tag, fields}` for one of your own.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temprature
    fields:
      header: header
      value: temperature

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

RULE = Rule("ING404", __name__, Severity.ERROR, __doc__)
