"""Hostile recordings, manifests and folders, through the real command: they cause errors at most."""

from __future__ import annotations

import json
import os
import resource
import struct
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from rosbags import rosbag2
from rosbags.typesys import Stores, get_typestore

MEMORY_BYTES = 4 << 30
SECONDS = 60
ESCAPES = "\x1b[31mred\x1b]0;owned\x07[bold]:skull:"
TOPICS = (
    "/ok", f"/{ESCAPES}", "/../../up", "/%2e%2e/%2e%2e/up", "/a/../../b", "//a//b", "/", "/.", "/CON", "/x\ny",
    "/\u202etxt.exe", "/" + "l" * 3000, "/nul\0", "/\u00fcber",
)  # fmt: skip
Ingest = Callable[..., "subprocess.CompletedProcess[str]"]


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@pytest.fixture
def ingest(tmp_path: Path) -> Ingest:
    """Run the command in the test's folder, within limits; a traceback or a control character fails the test."""

    def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
        result = subprocess.run(  # noqa: S603 - our own command
            [sys.executable, "-m", "mosaico_ingest", *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=SECONDS,
            encoding="utf-8",
            preexec_fn=_limited,
            check=False,
        )
        output = result.stdout + result.stderr
        assert "Traceback" not in output
        assert not {c for c in output if unicodedata.category(c) in {"Cc", "Cs"}} - {"\n"}
        assert "\u202e" not in output
        return result

    return run


def record(path: Path, topics: tuple[str, ...] = ("/ok",), *, text: str = "x") -> Path:
    """Write a recording of strings and return its file."""
    payload = text.encode() + b"\0"
    store = get_typestore(Stores.ROS2_HUMBLE)
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        for topic in topics:
            connection = writer.add_connection(topic, "std_msgs/msg/String", typestore=store)
            for time in range(3):
                writer.write(connection, time, b"\0\1\0\0" + struct.pack("<I", len(payload)) + payload)
    return next(path.glob("*.mcap"))


def job(folder: Path, text: str, name: str = "job.yaml") -> str:
    (folder / name).write_text(text)
    return name


@pytest.mark.slow
def test_hostile_topic_names_stay_in_the_store_and_off_the_terminal(tmp_path: Path, ingest: Ingest) -> None:
    record(tmp_path / "drive", TOPICS, text=ESCAPES)
    name = job(
        tmp_path, "bag: {path: drive}\nsequence: {name: s}\non_error: {session: report, topic: ignore}\n"
    )
    before = {path for path in tmp_path.parent.rglob("*") if (tmp_path / "mosaico") not in path.parents}
    assert "[bold]" in ingest("inspect", "drive").stdout
    assert ingest("run", name, "--report", "report.json").returncode == 4
    after = {path for path in tmp_path.parent.rglob("*") if (tmp_path / "mosaico") not in path.parents}
    assert {path.name for path in after - before} <= {"mosaico", "report.json"}
    topics = json.loads((tmp_path / "report.json").read_text())["recordings"][0]["topics"]
    assert [topic["topic"] for topic in topics] == list(TOPICS)
    assert {topic["topic"] for topic in topics if topic["written"]} == {"/ok", "/CON", "/" + "l" * 3000}
    ingest("store", "show", "s/ok")


@pytest.mark.slow
def test_file_name_with_any_bytes_is_read_and_reported(tmp_path: Path, ingest: Ingest) -> None:
    content = record(tmp_path / "drive").read_bytes()
    folder = os.fsencode(tmp_path / "all")
    os.mkdir(folder)  # noqa: PTH102 - pathlib takes no bytes
    for name in (b"new\nline.mcap", b"bad\xff\xfe.mcap", b"\x1b[31mred.mcap", b"-rf.mcap", b"[bold]x.mcap"):
        with open(os.path.join(folder, name), "wb") as file:  # noqa: PTH118, PTH123 - the same
            file.write(content)
    name = job(tmp_path, "bag: {path: 'all/*'}\nsequence: {name: 's_{stem}'}\n")
    assert ingest("plan", name, "--json").returncode == 0
    assert ingest("run", name, "--report", "report.json").returncode == 0
    report = json.loads((tmp_path / "report.json").read_text("utf-8"))
    assert "all/bad\\xff\\xfe.mcap" in {file for one in report["recordings"] for file in one["files"]}


@pytest.mark.slow
def test_folder_with_special_files_is_read_or_refused(tmp_path: Path, ingest: Ingest) -> None:
    folder = tmp_path / "all"
    record(tmp_path / "drive").rename(tmp_path / "good.mcap")
    folder.mkdir()
    (tmp_path / "good.mcap").rename(folder / "good.mcap")
    (folder / "empty.mcap").touch()
    (folder / "noise.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(range(256)) * 9)
    os.mkfifo(folder / "pipe.mcap")
    (folder / "loop.mcap").symlink_to("loop.mcap")
    (folder / "gone.mcap").symlink_to("nowhere")
    (folder / "self").symlink_to(".")
    name = job(tmp_path, "bag: {path: 'all/*'}\nsequence: {name: 's_{index}'}\n")
    report = ingest("run", name, "--quiet", "--report", "report.json")
    assert report.returncode == 1
    assert ingest("inspect", folder / "pipe.mcap").returncode == 1
    assert ingest("inspect", "all").returncode == 0


BOMB = "a: &a [x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join(['*' + old] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)
MATRIX = "matrix:\n" + "".join(f"  {axis}: [{', '.join(map(str, range(900)))}]\n" for axis in "abcd")
REFUSED = {
    "aliases": BOMB,
    "matrix": f"bag: {{path: drive}}\nsequence: {{name: '{{a}}{{b}}{{c}}{{d}}'}}\n{MATRIX}",
    "cycle": "extends: job.yaml\n",
    "doubling": "extends: [job1.yaml, job1.yaml]\n",
    "endless": "extends: /dev/zero\n",
    "pipe": "extends: pipe\n",
    "metadata pipe": "bag: {path: drive}\nsequence: {name: s, metadata_file: pipe}\n",
    "adapter pipe": "bag: {path: drive}\nadapters: {load: [pipe.yaml]}\n",
    "definition pipe": "bag: {path: drive, custom_msgs: [{package: p, path: msgs}]}\n",
    "digits": f"bag: {{path: drive}}\nsequence: {{metadata: {{a: {'9' * 9000}}}}}\n",
    "width": "bag: {path: drive}\nsequence: {name: 's{index:0999999999}'}\n",
    "depth": "a: " + "[" * 20_000,
    "object": "bag: !!python/object/apply:os.system ['touch sprung']\n",
    "surrogate": 'bag: {path: drive}\nsequence: {metadata: {a: "\\ud800"}}\n',
    "metadata": "bag: {path: drive}\nsequence: {name: s, metadata_file: deep.json}\n",
    "half a pair": "bag: {path: drive}\nsequence: {name: s, metadata_file: pair.json}\n",
    "not a number": "bag: {path: drive}\nsequence: {metadata: {a: .nan}}\n",
    "name": "bag: {path: drive}\nsequence: {name: ../../up}\n",
    "topic": "bag: {path: drive}\ntopic_settings: {/ok: {rename: ../../up}}\n",
    "secret": "bag: {path: drive}\ntarget: {host: h, api_key: s3cr3ts3cr3t, tsl: true}\n",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", REFUSED)
def test_hostile_manifest_is_refused(tmp_path: Path, ingest: Ingest, kind: str) -> None:
    record(tmp_path / "drive")
    os.mkfifo(tmp_path / "pipe")
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "deep.json").write_text('{"a": ' + '[{"b": ' * 400 + "1" + "}]" * 400 + "}")
    (tmp_path / "pair.json").write_text('{"a": "\\ud800"}')
    (tmp_path / "msgs").mkdir()
    (tmp_path / "msgs" / "Zero.msg").symlink_to("/dev/zero")
    for number in range(1, 25):
        job(tmp_path, f"extends: [job{number + 1}.yaml, job{number + 1}.yaml]\n", f"job{number}.yaml")
    job(tmp_path, "bag: {path: drive}\n", "job25.yaml")
    name = job(tmp_path, REFUSED[kind])
    linted, planned = ingest("lint", name), ingest("plan", name)
    assert planned.returncode != 0
    assert "s3cr3t" not in linted.stdout + linted.stderr + planned.stdout + planned.stderr
    assert not (tmp_path / "sprung").exists()
    assert not (tmp_path / "mosaico").exists()


@pytest.mark.slow
def test_module_runs_only_if_the_job_names_it(tmp_path: Path, ingest: Ingest) -> None:
    record(tmp_path / "drive")
    sprung = tmp_path / "sprung"
    (tmp_path / "trap.py").write_text(f"open({str(sprung)!r}, 'w').close()\nclass Trap: pass\n")
    innocent = job(tmp_path, "bag: {path: drive}\nadapters: {override: {/ok: trap.Trap}}\n", "innocent.yaml")
    naming = job(tmp_path, "bag: {path: drive}\nadapters: {load: ['trap.py:Trap']}\n", "naming.yaml")
    for command in (("plan", innocent), ("lint", naming)):
        ingest(*command)
        assert not sprung.exists(), command
    ingest("plan", naming)
    assert sprung.exists()


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".mcap.zstd", ".db3.zstd"])
def test_compressed_file_that_expands_enormously_stays_within_memory(
    tmp_path: Path, ingest: Ingest, suffix: str
) -> None:
    grown = zstandard.ZstdCompressor(level=1).compress(bytes(300 << 20))
    assert len(grown) < 60_000
    (tmp_path / f"bomb{suffix}").write_bytes(grown)
    assert ingest("inspect", f"bomb{suffix}").returncode == 1
