"""`missing-base`: a manifest extends a file that cannot be extended.

It is not there, holds no part of a manifest, or leads back to the manifest itself. Names in `extends` are as seen from the
manifest's folder and take no variables: what a job is made of must be known before they are filled in.

Bad:
    extends: nowhere.yaml
    bag: {path: data/run.mcap}

Good:
    extends: base.yaml
    bag: {path: data/run.mcap}
"""

from __future__ import annotations

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.rule import Rule

RULE = Rule("ING239", __name__, Severity.ERROR, __doc__)
