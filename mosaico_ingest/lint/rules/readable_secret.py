"""`readable-secret`: a key that others on this machine can read.

The manifest holds a key and its file mode lets every user of the machine read it.

Bad:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: not_a_real_key}  # ingest: ignore[plaintext-secret]

Good:
    bag: {path: data/run.mcap}
    target: {host: localhost, api_key: "${MOSAICO_API_KEY:-}"}
"""

from __future__ import annotations

import stat
from collections.abc import Iterator

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.rule import Problem, Rule


def check(job: Job) -> Iterator[Problem]:
    """Yield a problem if the file with the key is readable by everyone."""
    written = job.source.at(("target", "api_key"))
    if not isinstance(written, str) or "${" in written or job.file is None:
        return
    mode = job.file.stat().st_mode
    if mode & stat.S_IROTH:
        message = f"every user can read the key (mode {stat.S_IMODE(mode):o})"
        yield Problem(message, job.key_span("target", "api_key"), f"chmod 600 {job.file}")


RULE = Rule("ING228", __name__, Severity.ERROR, __doc__, job=check, disk=True)
