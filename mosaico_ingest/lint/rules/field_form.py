"""`field-form`: a value that says two things at once.

One of `value`, `use` and `fields` says where a value comes from.

Bad:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: {value: temperature, use: PoseAdapter}

Good:
    version: 1
    adapter: PackAdapter
    ros_type: sensor_msgs/msg/Temperature
    ontology: Temperature
    fields:
      header: header
      value: {value: temperature}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING410", __name__, Severity.ERROR, __doc__)
