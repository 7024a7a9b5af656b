"""The rule registry and its pages: every id in the source is registered, and every page and example is correct."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import mosaico_ingest
from mosaico_ingest import rules
from mosaico_ingest.lint.documents import Document, Kind, kind_of
from mosaico_ingest.lint.engine import lint_document
from mosaico_ingest.lint.rules import CHECKS
from mosaico_ingest.lint.settings import Settings
from mosaico_ingest.rules import LINT_RULES, RULES, Rule, find_rule, page_of

PACKAGE = Path(mosaico_ingest.__file__).parent
PAGES = PACKAGE.parent / "docs" / "rules"
MESSAGE_CHECKS = {check.rule for check in CHECKS if check.message is not None}
WITHOUT_EXAMPLE = {"unreadable-file", "not-utf8", "yaml-character", "adapter-cycle"}
"""Lint rules whose page cannot show a bad example in a single text file."""

RULE_ARGUMENTS = {
    "Finding": 0, "finding": 0, "_finding": 0, "_report": 0, "RowFailure": 1, "refuse": 1, "Rejected": 2,
    "report_inside": 2, "Trap": 0, "Check": 0,
}  # fmt: skip
"""The position of the rule id among the arguments of each function that takes one, other than as `rule=`."""


def rule_ids_in(tree: ast.AST) -> Iterator[tuple[str, int]]:
    """Yield each rule id that is passed as a literal, with its line."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            position = RULE_ARGUMENTS.get(name)
            values = [keyword.value for keyword in node.keywords if keyword.arg == "rule"]
            values += node.args[position : position + 1] if position is not None else []
            for value in values:
                yield from (
                    (leaf.value, leaf.lineno)
                    for leaf in (value, *ast.iter_child_nodes(value))
                    if isinstance(leaf, ast.Constant)
                    and isinstance(leaf.value, str)
                    and " " not in leaf.value
                )
        elif isinstance(node, ast.FunctionDef):
            arguments = [*node.args.args, *node.args.kwonlyargs]
            defaults = [*node.args.defaults, *node.args.kw_defaults]
            for argument, default in zip(reversed(arguments), reversed(defaults), strict=False):
                if argument.arg == "rule" and isinstance(default, ast.Constant):
                    yield str(default.value), node.lineno


def sources() -> Iterator[tuple[Path, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path, path.read_text()


def test_rule_ids_in_source_are_registered() -> None:
    unknown = [
        f"{path}:{line}: {rule}"
        for path, text in sources()
        for rule, line in rule_ids_in(ast.parse(text))
        if rule not in RULES
    ]
    assert unknown == []


def test_rule_ids_in_scans_calls_and_defaults() -> None:
    text = (
        "Finding('a', x)\nself.refuse(mask, 'b', f)\nDecodeError(x, rule='c')\n"
        "def report(x, *, rule='d'): ...\nFinding('e' if x else 'f', x)\n"
    )
    assert sorted(rule_ids_in(ast.parse(text))) == [
        ("a", 1),
        ("b", 2),
        ("c", 3),
        ("d", 4),
        ("e", 5),
        ("f", 5),
    ]


def test_registered_rules_are_used_in_source() -> None:
    text = "".join(text for path, text in sources() if path.name != "rules.py")
    assert [rule for rule in RULES if f'"{rule}"' not in text] == []


def test_findings_in_source_have_the_registered_severity() -> None:
    different = [
        f"{path}:{node.lineno}: {node.args[0].value}"
        for path, text in sources()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "Finding"
        and isinstance(node.args[0], ast.Constant)
        and isinstance(node.args[1], ast.Attribute)
        and node.args[1].attr != RULES[node.args[0].value].severity.name
    ]
    # An unknown rule is a warning in a comment, and an error in the settings, which would otherwise have no effect.
    assert [place.rpartition("/")[2].split(":")[0] for place in different] == ["settings.py"], different


def test_registry_has_unique_sorted_codes_and_ids() -> None:
    codes = [rule.code for rule in RULES.values()]
    assert codes == sorted(set(codes))
    assert all(re.fullmatch(r"ING\d{3}", code) for code in codes)
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", rule) for rule in RULES)
    assert all(rule.group for rule in RULES.values())


def test_find_rule_accepts_id_and_code() -> None:
    assert find_rule("yaml-tag") is find_rule("ING003") is RULES["yaml-tag"]
    assert find_rule("yaml-tga") is None


def test_check_modules_have_the_names_of_their_lint_rules() -> None:
    rules = [check.rule for check in CHECKS]
    shared = {
        "events": {"event-file", "event-interval", "event-overlap"},
        "msg-names": {"msg-field-name", "msg-constant-name"},
    }
    files = {path.stem.replace("_", "-") for path in (PACKAGE / "lint" / "rules").glob("*.py")}
    assert len(rules) == len(set(rules))
    assert files - {"--init--", *shared} == set(rules).difference(*shared.values())
    assert {check.rule for check in CHECKS} <= set(LINT_RULES)


def test_pages_match_registry() -> None:
    assert {path.stem for path in PAGES.glob("*.md")} == {*RULES, "README"}


@pytest.mark.parametrize("rule", RULES.values(), ids=lambda rule: rule.id)
def test_page_has_registered_heading_reason_and_fix(rule: Rule) -> None:
    page = page_of(rule)
    heading = f"# {rule.id} ({rule.code})\n\n**{rule.severity.value}** · {rule.summary}\n\n"
    assert page.startswith(heading)
    assert re.match(r"[A-Z`<].{20,}", page.removeprefix(heading))
    assert re.search(r"\n## How to fix\n\n[A-Z]", page)
    if rule.is_lint and rule.id not in WITHOUT_EXAMPLE:
        assert examples(rule, "Bad")
        assert examples(rule, "Good")


def test_page_of_installed_package_reads_packaged_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "yaml-tag.md").write_text("packaged")
    monkeypatch.setattr(rules, "_PAGE_FOLDERS", (tmp_path, PAGES))
    assert page_of(RULES["yaml-tag"]) == "packaged"
    assert '"docs/rules" = "mosaico_ingest/rule_pages"' in (PACKAGE.parent / "pyproject.toml").read_text()


def examples(rule: Rule, heading: str) -> list[str]:
    """Return the text of each code block below `## Bad` or `## Good`."""
    return re.findall(rf"\n## {heading}\n\n```\w+\n(.*?)```\n", page_of(rule), re.DOTALL)


def lint_example(rule: Rule, text: str, project: Path) -> list[str]:
    """Return the ids of the findings in an example of the page."""
    kind = Kind.MESSAGE if rule.id in MESSAGE_CHECKS else kind_of(text) or Kind.JOB
    name = "BatteryPack.msg" if kind is Kind.MESSAGE else "job.yaml"
    file = project / ("msgs" if kind is Kind.MESSAGE else "") / name
    file.write_text(text)
    file.chmod(0o644 if rule.id == "readable-secret" else 0o600)
    document = Document(name, text, kind, file.parent, file)
    findings = lint_document(document, env={}, settings=Settings())
    assert all(item.span is not None and (item.help or kind is Kind.ADAPTER) for item in findings)
    return [finding.rule for finding in findings]


@pytest.mark.parametrize("rule", LINT_RULES.values(), ids=lambda rule: rule.id)
def test_bad_examples_violate_only_their_rule(rule: Rule, project: Path) -> None:
    for text in examples(rule, "Bad"):
        assert lint_example(rule, text, project) == [rule.id]


@pytest.mark.parametrize("rule", LINT_RULES.values(), ids=lambda rule: rule.id)
def test_good_examples_violate_no_rule(rule: Rule, project: Path) -> None:
    for text in examples(rule, "Good"):
        assert lint_example(rule, text, project) == []
