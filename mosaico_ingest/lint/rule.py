"""This file is what a rule is: a code, a name, a page, and a check of a job or of a message definition."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from textwrap import dedent

from msgspec import Struct

from mosaico_ingest.findings import (
    Edit,
    Finding,
    Severity,
    Span,
)
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.message import MessageFile

__all__ = ["Problem", "Rule"]


class Problem(Struct, frozen=True):
    """What a rule found; the engine adds the rule's name and severity."""

    message: str
    span: Span
    help: str | None = None
    fix: Edit | None = None


class Rule(Struct, frozen=True):
    """A rule; without a check of its own it names what is found while the text is read."""

    code: str
    module: str
    severity: Severity
    page: str | None
    """The module's docstring: what, why, a bad and a good example."""
    job: Callable[[Job], Iterable[Problem]] | None = None
    message: Callable[[MessageFile], Iterable[Problem]] | None = None
    disk: bool = False
    """Whether it looks at files beside the document; such a rule says nothing about the examples of a page."""

    @property
    def name(self) -> str:
        """Its name, as `yaml-tag`; the file is called the same."""
        return self.module.rpartition(".")[2].replace("_", "-")

    @property
    def title(self) -> str:
        """Its page's first line without the name: what it finds, in a few words."""
        first = (self.page or "").strip("\n").splitlines()[0]
        return first.partition(": ")[2]

    def finding(self, problem: Problem) -> Finding:
        """Return a problem as a finding of this rule."""
        return Finding(self.name, self.severity, problem.message, problem.span, problem.help, problem.fix)

    def examples(self, heading: str) -> list[str]:
        r"""Return the blocks of the page under `Bad:` or `Good:`; a `\t` in them is a tab."""
        blocks: list[list[str]] = []
        inside = False
        for line in (self.page or "").replace("\\t", "\t").splitlines():
            if line == f"{heading}:":
                blocks.append([])
                inside = True
            elif inside and (not line or line.startswith("    ")):
                blocks[-1].append(line)
            else:
                inside = False
        return [dedent("\n".join(block)).strip("\n") + "\n" for block in blocks]
