"""Each rule's page is true: its bad examples break this rule and no other, its good ones none."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from mosaico_ingest.findings import Severity
from mosaico_ingest.lint import rules
from mosaico_ingest.lint.engine import Document, Kind, kind_of, lint_document
from mosaico_ingest.lint.rule import Rule
from mosaico_ingest.lint.rules import RULES
from mosaico_ingest.lint.settings import Settings

WITHOUT_EXAMPLE = {"unreadable-file", "not-utf8", "yaml-character", "adapter-cycle"}
"""What a page cannot show in one file."""


def kind(rule: Rule, text: str) -> Kind:
    return Kind.MESSAGE if rule.message is not None else kind_of(text) or Kind.JOB


def broken(rule: Rule, text: str, project: Path) -> list[str]:
    of = kind(rule, text)
    name = "BatteryPack.msg" if of is Kind.MESSAGE else "job.yaml"
    file = project / ("msgs" if of is Kind.MESSAGE else "") / name
    file.write_text(text)
    file.chmod(0o644 if rule.name == "readable-secret" else 0o600)
    document = Document(name, text, of, file.parent, file)
    found = lint_document(document, env={}, settings=Settings())
    assert all(finding.span is not None and (finding.help or of is Kind.ADAPTER) for finding in found)
    return [finding.rule for finding in found]


def test_the_list_has_every_file_and_no_name_or_code_twice() -> None:
    files = {path.stem for path in Path(rules.__file__).parent.glob("*.py")} - {"__init__"}
    assert {rule.name.replace("-", "_") for rule in RULES} == files
    assert len({rule.code for rule in RULES}) == len(RULES)
    assert [rule.code for rule in RULES] == sorted(rule.code for rule in RULES)
    assert len(RULES) >= 40


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_a_page_says_what_why_bad_and_good(rule: Rule) -> None:
    page = rule.page or ""
    assert page.startswith(f"`{rule.name}`: ")
    assert re.search(r"\n\n[^\n]{20}", page), "why"
    assert rule.severity in Severity
    if rule.name not in WITHOUT_EXAMPLE:
        assert rule.examples("Bad")
        assert rule.examples("Good")


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_the_bad_examples_break_this_rule_only(rule: Rule, project: Path) -> None:
    for text in rule.examples("Bad"):
        assert broken(rule, text, project) == [rule.name]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.name)
def test_the_good_examples_break_no_rule(rule: Rule, project: Path) -> None:
    for text in rule.examples("Good"):
        assert broken(rule, text, project) == []
