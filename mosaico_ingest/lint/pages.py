"""Access to the documentation pages of the rules, and the generator of their index, `docs/rules/README.md`."""

from __future__ import annotations

import sys
from itertools import groupby
from pathlib import Path

from mosaico_ingest.rules import RULES, Rule

_PACKAGE = Path(__file__).parents[1]
_FOLDERS = (_PACKAGE / "rule_pages", _PACKAGE.parent / "docs" / "rules")
"""The folder of the pages in an installed wheel, and in a checkout."""

_NOTICE = (
    "<!-- Generated from mosaico_ingest/rules.py by `python -m mosaico_ingest.lint.pages docs/rules`. -->\n\n"
)


def page_of(rule: Rule) -> str:
    """Return the documentation page of a rule as Markdown."""
    folder = next(folder for folder in _FOLDERS if folder.is_dir())
    return (folder / f"{rule.id}.md").read_text(encoding="utf-8")


def rule_index() -> str:
    """Return a Markdown table of all rules for each group."""
    tables = [
        f"\n## {group}\n\n| code | rule | severity | problem |\n|---|---|---|---|\n{''.join(map(_row, rules))}"
        for group, rules in groupby(RULES.values(), key=lambda rule: rule.group)
    ]
    return (
        "# Rules\n\nAfter reading this page, you can look up a finding of lint, plan or run, or the reason of a rejected row. "
        "`ingest lint --explain RULE` prints the same page.\n" + "".join(tables)
    )


def _row(rule: Rule) -> str:
    return f"| {rule.code} | [{rule.id}]({rule.id}.md) | {rule.severity.value} | {rule.summary} |\n"


if __name__ == "__main__":
    Path(sys.argv[1], "README.md").write_text(_NOTICE + rule_index(), encoding="utf-8")
