"""`adapter-file`: an adapter file that does not hold together.

Either `ros_type` or `variants` says what the adapter takes; without one of them it takes nothing.

Bad:
    version: 1
    adapter: PackAdapter
    ontology: Temperature
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

RULE = Rule("ING411", __name__, Severity.ERROR, __doc__)
