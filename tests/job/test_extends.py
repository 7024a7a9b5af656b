"""Composition of manifests: merge order, rewritten paths, variables, matrices and spans."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.manifest import load_manifest, load_manifests, read_manifest
from mosaico_ingest.job.reference import expand_manifest, to_yaml
from mosaico_ingest.job.yaml_source import Value, load_source

BASE = """\
version: 1
bag: {ros_distro: ros2_humble, custom_msgs: [{package: p, path: msgs}]}
topics: [/a, /b, /c]
adapters:
  load: [adapters/a.yaml, adapters/b.py:Pack, pkg.module:Pack]
  override: {"/cam*": CamAdapter, /imu: adapters/imu.yaml}
target: {host: h, port: 1}
run: {report: /var/report.json}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "fleet").mkdir()
    (tmp_path / "jobs").mkdir()
    (tmp_path / "fleet" / "base.yaml").write_text(BASE)
    return tmp_path


def job(folder: Path, text: str) -> Path:
    file = folder / "jobs" / "job.yaml"
    file.write_text(text)
    return file


def findings(file: Path) -> list[tuple[str, str]]:
    with pytest.raises(ManifestError) as caught:
        load_manifests(file, env={})
    return [
        (f.rule, f"{Path(f.span.file).name}:{f.span.line}:{f.span.column}")
        for f in caught.value.findings
        if f.span is not None
    ]


def test_extends_merges_mappings_and_replaces_other_values(folder: Path) -> None:
    text = "extends: ../fleet/base.yaml\nbag: {path: x.bag}\ntopics: [/d]\nadapters: {override: {/lidar: L}}"
    manifest = load_manifest(job(folder, text)).manifest
    assert manifest.bag.path == "x.bag"
    assert str(manifest.bag.ros_distro and manifest.bag.ros_distro.value) == "ros2_humble"
    assert manifest.topics == ("/d",)
    assert list(manifest.adapters.override) == ["/lidar", "/cam*", "/imu"]  # its own come first
    assert manifest.target.port == 1


def test_extends_relative_paths_are_rewritten(folder: Path) -> None:
    manifest = load_manifest(job(folder, "extends: ../fleet/base.yaml\nbag: {path: x.bag}")).manifest
    assert manifest.bag.custom_msgs[0].path == "../fleet/msgs"
    assert manifest.adapters.load == (
        "../fleet/adapters/a.yaml",
        "../fleet/adapters/b.py:Pack",
        "pkg.module:Pack",
    )
    assert manifest.adapters.override == {"/cam*": "CamAdapter", "/imu": "../fleet/adapters/imu.yaml"}
    assert manifest.run.report == "/var/report.json"


def test_extends_empty_value_removes_key(folder: Path) -> None:
    text = "extends: ../fleet/base.yaml\nbag: {path: x.bag}\ntarget: {host: null, port: null, store: s}"
    target = load_manifest(job(folder, text)).manifest.target
    assert (target.host, target.store) == (None, "s")


def test_extends_later_file_takes_precedence(folder: Path) -> None:
    (folder / "fleet" / "night.yaml").write_text("extends: dark.yaml\ntopics: [/night]")
    (folder / "fleet" / "dark.yaml").write_text("on_error: {topic: ignore}\ntopics: [/dark]")
    text = "extends: [../fleet/base.yaml, ../fleet/night.yaml]\nbag: {path: x.bag}"
    manifest = load_manifest(job(folder, text)).manifest
    assert manifest.topics == ("/night",)
    assert manifest.on_error.topic.value == "ignore"  # type: ignore[union-attr] # one word was given
    assert manifest.target.host == "h"


def test_extends_mistake_is_located_in_its_file(folder: Path) -> None:
    (folder / "fleet" / "base.yaml").write_text(
        "on_error: {topic: finalise}\nrun: {jobs: '2'}\nsequence: {nam: x}"
    )
    file = job(folder, "extends: ../fleet/base.yaml\nbag: {path: x.bag, ros_distro: humble}")
    assert sorted(findings(file)) == [
        ("unknown-key", "base.yaml:3:12"),
        ("wrong-type", "base.yaml:2:13"),
        ("wrong-value", "base.yaml:1:19"),
        ("wrong-value", "job.yaml:2:32"),
    ]


@pytest.mark.parametrize(
    ("text", "base", "location", "message"),
    [
        ("extends: gone.yaml", "", "job.yaml:1:10", "no such file"),
        ("extends: [../fleet/base.yaml, gone.yaml]", "version: 1", "job.yaml:1:31", "no such file"),
        ("extends: job.yaml", "", "job.yaml:1:10", "extend one another: job.yaml → job.yaml"),
        ("extends: ../fleet/base.yaml", "extends: ../jobs/job.yaml", "job.yaml:1:10", "extend one another"),
        ("extends: ../fleet/base.yaml", "[1]", "job.yaml:1:10", "is not a mapping"),
        ("extends: ../fleet", "", "job.yaml:1:10", "cannot be extended"),
    ],
)
def test_extends_invalid_base_is_only_finding(
    folder: Path, text: str, base: str, location: str, message: str
) -> None:
    (folder / "fleet" / "base.yaml").write_text(base)
    file = job(folder, text)
    assert set(findings(file)) == {("missing-base", location)}
    with pytest.raises(ManifestError, match=message):
        load_manifests(file)


def test_extends_syntax_error_is_located_in_base(folder: Path) -> None:
    (folder / "fleet" / "base.yaml").write_text("topics: [!/a]\n")
    assert findings(job(folder, "extends: ../fleet/base.yaml\nbag: {path: x}")) == [
        ("yaml-tag", "base.yaml:1:10")
    ]


def test_variables_matrix_overrides_environment_and_defaults(folder: Path) -> None:
    text = (
        "defaults: {A: a, B: b, C: c}\nmatrix: {C: [x, 7]}\nbag: {path: '${A}${B}${C}'}\nrun: {jobs: '${C}'}"
    )
    file = job(folder, text.replace("run: {jobs: '${C}'}", ""))
    paths = [one.manifest.bag.path for one in load_manifests(file, env={"B": "env", "C": "env"})]
    assert paths == ["aenvx", "aenv7"]
    assert [one.cell for one in load_manifests(file, env=None)] == [{"C": "x"}, {"C": "7"}]


def test_matrix_expands_to_all_or_listed_combinations(folder: Path) -> None:
    axes = job(folder, "matrix: {v: [a, b], d: [1, 2]}\nbag: {path: '${v}/${d}'}\nrun: {jobs: '${d}'}")
    assert [(one.manifest.bag.path, one.manifest.run.jobs) for one in load_manifests(axes, env={})] == [
        ("a/1", 1), ("a/2", 2), ("b/1", 1), ("b/2", 2),
    ]  # fmt: skip
    cells = job(folder, "matrix: [{v: a, d: 1}, {v: b, d: 2}]\nbag: {path: '${v}/${d}'}")
    assert [one.manifest.bag.path for one in load_manifests(cells, env={})] == ["a/1", "b/2"]


@pytest.mark.parametrize(
    ("matrix", "location"),
    [
        ("{v: a}", "job.yaml:1:13"),
        ("{v: []}", "job.yaml:1:13"),
        ("{v: [[1]]}", "job.yaml:1:14"),
        ("{v: [true]}", "job.yaml:1:14"),
        ("[1]", "job.yaml:1:10"),
        ("7", "job.yaml:1:9"),
        ("{a b: [1]}", "job.yaml:1:15"),
        (f"{{a: {list(range(50))}, b: {list(range(50))}}}", "job.yaml:1:9"),
    ],
)
def test_matrix_invalid_value_is_one_located_finding(folder: Path, matrix: str, location: str) -> None:
    actual = findings(job(folder, f"matrix: {matrix}\nbag: {{path: x}}"))
    assert [where for _, where in actual] == [location]


def test_matrix_findings_of_all_combinations_are_deduplicated(folder: Path) -> None:
    text = "matrix: {v: [1, 2]}\nbag: {path: x}\nsequence: {nam: x}\nrun: {jobs: '${v}x'}"
    assert findings(job(folder, text)) == [("unknown-key", "job.yaml:3:12"), ("wrong-type", "job.yaml:4:13")]


def test_expand_manifest_expanded_documents_load_as_same_jobs(folder: Path) -> None:
    file = job(
        folder,
        "extends: ../fleet/base.yaml\nmatrix: {v: ['a$', b], n: [2]}\ndefaults: {S: s, n: 1}\n"
        "bag: {path: '${v}/${S}/${E}$$'}\nrun: {jobs: '${n}'}\nsequence: {metadata: {x: 1e3, y: '1e3'}}",
    )
    env = {"E": "e"}
    for expanded, loaded in zip(expand_manifest(file), load_manifests(file, env=env), strict=True):
        alone = folder / "jobs" / "alone.yaml"
        alone.write_text(to_yaml(expanded.value, expanded.remark))
        again = load_manifest(alone, env=env).manifest
        unlike = {"extends", "matrix", "defaults"}
        assert again.model_dump(exclude=unlike) == loaded.manifest.model_dump(exclude=unlike)
        assert "base.yaml:3" in alone.read_text()


def test_line_of_extended_file_is_read_from_that_file(folder: Path) -> None:
    source = read_manifest(job(folder, "extends: ../fleet/base.yaml\nbag: {path: x}"))
    assert source.line(source.span(("target", "host"))) == "target: {host: h, port: 1}"
    assert source.inner_span(("target", "host"), 0, 1).file.endswith("base.yaml")


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


@given(VALUES)
def test_to_yaml_any_value_round_trips_in_all_readers(value: Value) -> None:
    text = to_yaml(value)
    read = load_source(text, file="x")
    assert not read.findings
    assert read.value == value
    assert json.dumps(yaml.safe_load(text)) == json.dumps(value)
