"""The interface of a lint check: a function that yields the problems of one job or one `.msg` file."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from msgspec import Struct

from mosaico_ingest.findings import Edit, Finding, Span
from mosaico_ingest.lint.job import Job
from mosaico_ingest.lint.message import MessageFile
from mosaico_ingest.rules import RULES


class Problem(Struct, frozen=True):
    """A violation of a rule, without the rule's id and severity."""

    message: str
    span: Span
    help: str | None = None
    fix: Edit | None = None


class Check(Struct, frozen=True):
    """The check of one rule, for jobs or for message definitions."""

    rule: str
    """The id of the rule."""
    job: Callable[[Job], Iterable[Problem]] | None = None
    message: Callable[[MessageFile], Iterable[Problem]] | None = None
    reads_files: bool = False
    """Whether the check looks at files next to the document. Such checks do not run on examples in Markdown pages."""

    def finding(self, problem: Problem) -> Finding:
        """Return a problem as a finding of this rule."""
        rule = RULES[self.rule]
        return Finding(rule.id, rule.severity, problem.message, problem.span, problem.help, problem.fix)
