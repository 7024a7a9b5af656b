"""This file makes the rules' pages from their docstrings: for `docs/rules/` and for `ingest lint --explain`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from mosaico_ingest.lint.rule import Rule
from mosaico_ingest.lint.rules import RULES

__all__ = ["index", "page", "write_pages"]

_NOTICE = "<!-- made from the rules' docstrings -->\n\n"


def page(rule: Rule) -> str:
    """Return a rule's page as Markdown."""
    body = (rule.page or "").strip("\n").split("\n", 2)[2].strip("\n")
    why = body.split("\nBad:\n", 1)[0].strip("\n")
    head = f"# {rule.name} ({rule.code})\n\n**{rule.severity.value}** · {rule.title}\n\n{why}\n"
    return head + "".join(_blocks(rule))


def index() -> str:
    """Return the table of all rules as Markdown."""
    rows = "".join(
        f"| {rule.code} | [{rule.name}]({rule.name}.md) | {rule.severity.value} | {rule.title.rstrip('.')} |\n"
        for rule in RULES
    )
    return f"# Rules of `ingest lint`\n\n| code | rule | severity | finds |\n|---|---|---|---|\n{rows}"


def write_pages(folder: Path) -> None:
    """Write every page and the index into a folder, which then holds nothing else of ours."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("*.md"):
        stale.unlink()
    (folder / "README.md").write_text(_NOTICE + index(), encoding="utf-8")
    for rule in RULES:
        (folder / f"{rule.name}.md").write_text(_NOTICE + page(rule), encoding="utf-8")


def _blocks(rule: Rule) -> Iterator[str]:
    """Yield the examples; the bad ones are marked, so that linting the page does not find them."""
    language = "text" if rule.message is not None else "yaml"
    for heading in ("Bad", "Good"):
        for example in rule.examples(heading):
            shown = language if heading == "Good" else "text"
            yield f"\n{heading}:\n\n```{shown}\n{example}```\n"


if __name__ == "__main__":
    write_pages(Path(sys.argv[1]))
