"""The exceptions of this package, each with its exit code and whether a retry may help.

IngestError
├── ManifestError        the manifest cannot become a job                      exit code 2
├── NothingMatched       no recording or no topic is selected                  exit code 3
├── BagError             the recording cannot be read                          exit code 1
│   ├── DecodeError      a message does not fit its type
│   └── DefinitionError  a message definition of the job is invalid            exit code 2
├── AdapterError         an adapter is invalid or does not fit a message type  exit code 1
├── SinkError            the destination refuses an operation                  exit code 1
│   ├── SequenceExists   the sequence already exists
│   └── SinkUnavailable  the destination does not respond; a retry may help
├── Unreachable          a URL does not respond or its content changed; a retry may help  exit code 1
├── ViewError            stored data cannot be shown                           exit code 1
├── ContractError        the recording or its metadata violates a contract    exit code 6
├── VerificationError    the stored data differ from the recording             exit code 5
└── Interrupted          a signal stopped the run                              exit code 130
"""

from __future__ import annotations

from collections.abc import Collection
from typing import ClassVar

from mosaico_ingest.findings import Finding, one_line

__all__ = [
    "AdapterError",
    "BagError",
    "ContractError",
    "DecodeError",
    "DefinitionError",
    "IngestError",
    "Interrupted",
    "ManifestError",
    "NothingMatched",
    "SequenceExists",
    "SinkError",
    "SinkUnavailable",
    "Unreachable",
    "VerificationError",
    "ViewError",
]

_GRAVEST_FIRST = (130, 5, 1, 2, 6, 3, 4)


class IngestError(Exception):
    """The base class of all errors: a problem with its location and a hint. Its text is one line."""

    exit_code: ClassVar[int] = 1
    """The exit code of the command."""
    retryable: ClassVar[bool] = False
    """Whether running the job again may help."""

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        hint: str | None = None,
        findings: tuple[Finding, ...] = (),
    ) -> None:
        """Create the error.

        Args:
            what: The problem and the value.
            where: The location, such as `job.yaml:3:5`, a path or a topic.
            hint: A hint that starts with an imperative.
            findings: The findings, if the error reports several problems.
        """
        super().__init__(what)
        self.what = what
        self.where = where
        self.hint = hint
        self.findings = findings

    def __str__(self) -> str:
        """Return `where: what — hint`, without the parts that are None."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        return one_line(f"{text} — {self.hint}" if self.hint else text)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep all attributes when the error is pickled for another process."""
        return (_rebuild, (type(self), self.what, dict(self.__dict__)))


def _rebuild(kind: type[IngestError], what: str, attributes: dict[str, object]) -> IngestError:
    error = kind.__new__(kind, what)
    error.args = (what,)
    error.__dict__.update(attributes)
    return error


class ManifestError(IngestError):
    """The manifest cannot become a job. `findings` has one entry per mistake."""

    exit_code = 2


class NothingMatched(IngestError):  # noqa: N818 - named after the condition, as in the table of exit codes
    """No recording or no topic is selected."""

    exit_code = 3


class BagError(IngestError):
    """The recording cannot be read."""


class DecodeError(BagError):
    """A message does not fit its type."""

    def __init__(
        self, what: str, *, rule: str = "decode", where: str | None = None, hint: str | None = None
    ) -> None:
        """Create the error; `rule` is the rule id of the rejected row."""
        super().__init__(what, where=where, hint=hint)
        self.rule = rule


class DefinitionError(BagError):
    """A message definition that the job provides is invalid. `findings` has the location in its file."""

    exit_code = 2


class AdapterError(IngestError):
    """An adapter or its file is invalid, or the adapter does not fit a message type."""


class SinkError(IngestError):
    """The destination refuses an operation."""


class SequenceExists(SinkError):  # noqa: N818 - named after the condition
    """The sequence already exists, and the job does not allow changing it."""


class SinkUnavailable(SinkError):  # noqa: N818 - named after the condition
    """The destination does not respond."""

    retryable = True


class Unreachable(IngestError):  # noqa: N818 - named after the condition
    """A URL does not respond, or its content changed while it was read."""

    retryable = True


class ViewError(IngestError):
    """Stored data cannot be shown, such as an image in an unknown encoding."""


class ContractError(IngestError):
    """The recording or its metadata violates a contract of the job. `findings` has one entry per violation."""

    exit_code = 6


class VerificationError(IngestError):
    """The stored data differ from the recording."""

    exit_code = 5


class Interrupted(IngestError):  # noqa: N818 - named after the condition
    """A signal stopped the run, after the session policy was applied."""

    exit_code = 130


def missing_library(library: str, extra: str) -> IngestError:
    """Return the error for a library that the extra `extra` of this package installs."""
    return IngestError(f"{library} is not installed", hint=f"pip install 'mosaico-ingest[{extra}]'")


def gravest(codes: Collection[int]) -> int:
    """Return the exit code of a run whose recordings have these exit codes."""
    return next((code for code in _GRAVEST_FIRST if code in codes), max(codes, default=0))
