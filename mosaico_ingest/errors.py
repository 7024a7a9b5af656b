"""This file is the exception tree; each error knows its exit code and whether trying again may help.

IngestError
├── ManifestError        the YAML cannot become a job            exit 2
├── NothingMatched       no bag or no topic selected             exit 3
├── BagError             the recording cannot be read            exit 1
│   └── DecodeError      bytes do not fit their type
├── AdapterError         rows do not fit their ontology          exit 1
├── SinkError            the destination refused                 exit 1
│   ├── SequenceExists   … the name is taken
│   └── SinkUnavailable  … and trying again may help
├── Unreachable          a URL did not answer, or its content changed under way; again may help  exit 1
├── VerificationError    what is stored is not what was read     exit 5
└── Interrupted          a signal asked to stop                  exit 130
"""

from __future__ import annotations

from typing import ClassVar

from mosaico_ingest.findings import Finding, one_line

__all__ = [
    "AdapterError",
    "BagError",
    "DecodeError",
    "IngestError",
    "Interrupted",
    "ManifestError",
    "NothingMatched",
    "SequenceExists",
    "SinkError",
    "SinkUnavailable",
    "Unreachable",
    "VerificationError",
]


class IngestError(Exception):
    """What went wrong, where, with which value, and what to do; one line when printed."""

    exit_code: ClassVar[int] = 1
    """What the command exits with."""
    retryable: ClassVar[bool] = False
    """Whether running again may help; for whoever runs jobs from Python."""

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        hint: str | None = None,
        findings: tuple[Finding, ...] = (),
    ) -> None:
        super().__init__(what)
        self.what = what
        self.where = where
        self.hint = hint
        self.findings = findings
        """One for each mistake, where there can be several, with its place."""

    def __str__(self) -> str:
        """Return `where: what — hint` with the parts that are known."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        return one_line(f"{text} — {self.hint}" if self.hint else text)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the fields when the error crosses a process border."""
        return (_rebuild, (type(self), self.what, dict(self.__dict__)))


def _rebuild(kind: type[IngestError], what: str, fields: dict[str, object]) -> IngestError:
    error = kind.__new__(kind, what)
    error.args = (what,)
    error.__dict__.update(fields)
    return error


class ManifestError(IngestError):
    """The YAML cannot become a job; `findings` says where, one for each mistake."""

    exit_code = 2


class NothingMatched(IngestError):  # noqa: N818 - it names what happened, as the exit code's table does
    """No recording or no topic was selected."""

    exit_code = 3


class BagError(IngestError):
    """The recording cannot be read."""


class DecodeError(BagError):
    """A message's bytes do not fit its type; `rule` is the short name failures are counted by."""

    def __init__(
        self, what: str, *, rule: str = "decode", where: str | None = None, hint: str | None = None
    ) -> None:
        super().__init__(what, where=where, hint=hint)
        self.rule = rule


class AdapterError(IngestError):
    """Rows do not fit their ontology, an adapter does not fit its message type, or its file is wrong (`findings`)."""


class SinkError(IngestError):
    """The destination refused."""


class SequenceExists(SinkError):  # noqa: N818 - the condition, as `NothingMatched`
    """The sequence's name is taken and the job said to fail then."""


class SinkUnavailable(SinkError):  # noqa: N818 - the condition, as `NothingMatched`
    """The destination did not answer; trying again may help."""

    retryable = True


class Unreachable(IngestError):  # noqa: N818 - the condition, as `NothingMatched`
    """What lies behind a URL did not answer, or changed while it was read; trying again may help."""

    retryable = True


class VerificationError(IngestError):
    """What is stored is not what was read."""

    exit_code = 5


class Interrupted(IngestError):  # noqa: N818 - the condition, as `NothingMatched`
    """A signal asked the run to stop; the session policy was applied."""

    exit_code = 130
