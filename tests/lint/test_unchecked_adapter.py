"""Adapter files whose message definition lint does or does not know."""

from __future__ import annotations

from pathlib import Path

from mosaico_ingest.lint.engine import lint_paths

ADAPTER = """\
version: 1
adapter: PackAdapter
ros_type: acme_msgs/msg/Pack
ontology: Pressure
fields:
  value: presure
"""


def findings(folder: Path) -> list[tuple[str, int]]:
    path = folder / "adapters" / "pack.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(ADAPTER)
    return [
        (finding.rule, finding.span.line) for finding in lint_paths([path], env=None).findings if finding.span
    ]


def test_lint_adapter_of_unknown_type_reports_unchecked_adapter(tmp_path: Path) -> None:
    assert findings(tmp_path) == [("unchecked-adapter", 3)]


def test_lint_adapter_with_definition_nearby_checks_fields(tmp_path: Path) -> None:
    (tmp_path / "acme_msgs").mkdir()
    (tmp_path / "acme_msgs" / "Pack.msg").write_text("float64 pressure\n")
    assert findings(tmp_path) == [("unknown-field", 6)]
