"""A manifest has what it extends: joined, in order, with paths that still lead to their files and places that are true."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from mosaico_ingest.errors import ManifestError
from mosaico_ingest.job.expand import expand_manifest, to_yaml
from mosaico_ingest.job.manifest import load_manifest, load_manifests, read_manifest
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


def test_mappings_are_joined_and_the_rest_is_replaced(folder: Path) -> None:
    text = "extends: ../fleet/base.yaml\nbag: {path: x.bag}\ntopics: [/d]\nadapters: {override: {/lidar: L}}"
    manifest = load_manifest(job(folder, text)).manifest
    assert manifest.bag.path == "x.bag"
    assert str(manifest.bag.ros_distro and manifest.bag.ros_distro.value) == "ros2_humble"
    assert manifest.topics == ("/d",)
    assert list(manifest.adapters.override) == ["/lidar", "/cam*", "/imu"]  # its own come first
    assert manifest.target.port == 1


def test_paths_of_another_file_lead_where_they_led(folder: Path) -> None:
    manifest = load_manifest(job(folder, "extends: ../fleet/base.yaml\nbag: {path: x.bag}")).manifest
    assert manifest.bag.custom_msgs[0].path == "../fleet/msgs"
    assert manifest.adapters.load == (
        "../fleet/adapters/a.yaml",
        "../fleet/adapters/b.py:Pack",
        "pkg.module:Pack",
    )
    assert manifest.adapters.override == {"/cam*": "CamAdapter", "/imu": "../fleet/adapters/imu.yaml"}
    assert manifest.run.report == "/var/report.json"


def test_an_empty_value_takes_a_key_away(folder: Path) -> None:
    text = "extends: ../fleet/base.yaml\nbag: {path: x.bag}\ntarget: {host: null, port: null, store: s}"
    target = load_manifest(job(folder, text)).manifest.target
    assert (target.host, target.store) == (None, "s")


def test_later_files_count_more_and_files_extend_files(folder: Path) -> None:
    (folder / "fleet" / "night.yaml").write_text("extends: dark.yaml\ntopics: [/night]")
    (folder / "fleet" / "dark.yaml").write_text("on_error: {topic: ignore}\ntopics: [/dark]")
    text = "extends: [../fleet/base.yaml, ../fleet/night.yaml]\nbag: {path: x.bag}"
    manifest = load_manifest(job(folder, text)).manifest
    assert manifest.topics == ("/night",)
    assert manifest.on_error.topic.value == "ignore"  # type: ignore[union-attr] # one word was given
    assert manifest.target.host == "h"


def test_a_mistake_is_shown_in_the_file_that_holds_it(folder: Path) -> None:
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
    ("text", "base", "place", "message"),
    [
        ("extends: gone.yaml", "", "job.yaml:1:10", "no such file"),
        ("extends: [../fleet/base.yaml, gone.yaml]", "version: 1", "job.yaml:1:31", "no such file"),
        ("extends: job.yaml", "", "job.yaml:1:10", "extend one another: job.yaml → job.yaml"),
        ("extends: ../fleet/base.yaml", "extends: ../jobs/job.yaml", "job.yaml:1:10", "extend one another"),
        ("extends: ../fleet/base.yaml", "[1]", "job.yaml:1:10", "is not a mapping"),
        ("extends: ../fleet", "", "job.yaml:1:10", "cannot be extended"),
    ],
)
def test_what_cannot_be_extended_is_the_only_thing_said(
    folder: Path, text: str, base: str, place: str, message: str
) -> None:
    (folder / "fleet" / "base.yaml").write_text(base)
    file = job(folder, text)
    assert set(findings(file)) == {("missing-base", place)}
    with pytest.raises(ManifestError, match=message):
        load_manifests(file)


def test_syntax_errors_of_a_base_are_shown_there(folder: Path) -> None:
    (folder / "fleet" / "base.yaml").write_text("topics: [!/a]\n")
    assert findings(job(folder, "extends: ../fleet/base.yaml\nbag: {path: x}")) == [
        ("yaml-tag", "base.yaml:1:10")
    ]


def test_defaults_give_way_to_the_environment_and_that_to_the_matrix(folder: Path) -> None:
    text = (
        "defaults: {A: a, B: b, C: c}\nmatrix: {C: [x, 7]}\nbag: {path: '${A}${B}${C}'}\nrun: {jobs: '${C}'}"
    )
    file = job(folder, text.replace("run: {jobs: '${C}'}", ""))
    paths = [one.manifest.bag.path for one in load_manifests(file, env={"B": "env", "C": "env"})]
    assert paths == ["aenvx", "aenv7"]
    assert [one.cell for one in load_manifests(file, env=None)] == [{"C": "x"}, {"C": "7"}]


def test_a_matrix_is_every_combination_or_those_given(folder: Path) -> None:
    axes = job(folder, "matrix: {v: [a, b], d: [1, 2]}\nbag: {path: '${v}/${d}'}\nrun: {jobs: '${d}'}")
    assert [(one.manifest.bag.path, one.manifest.run.jobs) for one in load_manifests(axes, env={})] == [
        ("a/1", 1), ("a/2", 2), ("b/1", 1), ("b/2", 2),
    ]  # fmt: skip
    cells = job(folder, "matrix: [{v: a, d: 1}, {v: b, d: 2}]\nbag: {path: '${v}/${d}'}")
    assert [one.manifest.bag.path for one in load_manifests(cells, env={})] == ["a/1", "b/2"]


@pytest.mark.parametrize(
    ("matrix", "place"),
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
def test_a_wrong_matrix_is_one_finding(folder: Path, matrix: str, place: str) -> None:
    found = findings(job(folder, f"matrix: {matrix}\nbag: {{path: x}}"))
    assert [where for _, where in found] == [place]


def test_the_findings_of_all_combinations_are_told_once(folder: Path) -> None:
    text = "matrix: {v: [1, 2]}\nbag: {path: x}\nsequence: {nam: x}\nrun: {jobs: '${v}x'}"
    assert findings(job(folder, text)) == [("unknown-key", "job.yaml:3:12"), ("wrong-type", "job.yaml:4:13")]


def test_what_is_expanded_is_the_same_jobs_without_anything_to_extend(folder: Path) -> None:
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


def test_lines_of_another_file_are_read_from_it(folder: Path) -> None:
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
def test_written_yaml_reads_back_as_the_same_values_for_everybody(value: Value) -> None:
    text = to_yaml(value)
    read = load_source(text, file="x")
    assert not read.findings
    assert read.value == value
    assert json.dumps(yaml.safe_load(text)) == json.dumps(value)
