"""`unknown-column`: a target that the ontology does not have.

The keys of `fields` are columns of the ontology's record; a misspelt one would leave its column empty.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: temperature
      varience: variance

Good:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: temperature
      variance: variance
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING402", __name__, Severity.ERROR, __doc__)
