"""Mistakes of users: one line with problem, location and hint, the documented exit code, and no traceback."""

from __future__ import annotations

import os
import re
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from disks import read_only
from rosbags.rosbag1 import Writer

from mosaico_ingest.cli.app import main

Ingest = Callable[..., tuple[int, str, str]]
QUICKSTART = Path(__file__).resolve().parents[2] / "configs" / "quickstart" / "drive.mcap"


@pytest.fixture
def ingest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ingest:
    """Run the command in an empty folder; return exit code, output and errors."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        code = 0
        try:
            main(arguments)
        except SystemExit as leave:
            code = int(leave.code or 0)
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return code, out, err

    return run


def job(folder: Path, text: str) -> str:
    (folder / "job.yaml").write_text(text)
    return "job.yaml"


GOOD = f"version: 1\nbag: {{path: {QUICKSTART}}}\nsequence: {{name: good}}\n"


def test_run_missing_manifest_exits_2(ingest: Ingest) -> None:
    code, _, err = ingest("nowhere.yaml")
    assert code == 2
    assert "nowhere.yaml" in err


def test_run_manifest_not_a_mapping_exits_2_with_location(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, "- one\n- two\n"))
    assert code == 2
    assert "job.yaml:1:1" in err


def test_run_unknown_key_exits_2_with_location_and_suggestion(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, GOOD.replace("bag:", "bga:")))
    assert code == 2
    assert "job.yaml:2:1" in err
    assert "bag" in err


def test_run_missing_recording_exits_3(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, "version: 1\nbag: {path: gone.mcap}\nsequence: {name: x}\n"))
    assert code == 3
    assert "gone.mcap" in err
    assert not (tmp_path / "mosaico").exists()


def test_bag_empty_recording_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "empty.bag").touch()
    code, _, err = ingest("bag", "empty.bag", "--name", "x")
    assert code == 1
    assert "empty" in err


def test_bag_text_file_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello, this is no recording at all\n")
    code, _, err = ingest("bag", "text.mcap", "--name", "x")
    assert code == 1
    assert "text.mcap" in err


def test_bag_directory_without_recording_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    code, _, err = ingest("bag", "empty", "--name", "x")
    assert code in {1, 3}
    assert "empty" in err


def test_bag_unwritable_store_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "mosaico").write_text("a file where the store should be")
    code, _, err = ingest(job(tmp_path, GOOD))
    assert code == 1
    assert "mosaico" in err


def test_bag_store_of_newer_format_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "-q")[0] == 0
    with sqlite3.connect(tmp_path / "mosaico" / "catalog.sqlite") as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    code, _, err = ingest(job(tmp_path, GOOD.replace("good", "other")))
    assert code == 1
    assert "99" in err


def test_bag_existing_sequence_is_unchanged(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "-q")[0] == 0
    code, _, err = ingest(job(tmp_path, GOOD))
    assert code == 1
    assert "good" in err
    assert "if_exists" in err
    assert ingest("store", "show", "good")[0] == 0


def test_main_unknown_command_suggests_nearest(ingest: Ingest) -> None:
    code, _, err = ingest("inspct")
    assert code == 2
    assert "did you mean `ingest inspect`" in err


def test_bag_metadata_not_an_object_exits_2(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--metadata", "[1]")
    assert code == 2
    assert "--metadata" in err


def test_bag_metadata_file_not_utf8_exits_2(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "metadata.json").write_bytes(b"\x80\xff")
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--metadata", "metadata.json")
    assert code == 2
    assert "metadata.json: is not JSON" in err


def test_bag_unknown_distro_exits_2(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--ros-distro", "ros2_hmble")
    assert code == 2
    assert "ros2_humble" in err


def test_bag_unknown_log_level_exits_2(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--log", "LOUD")
    assert code == 2
    assert "LOUD" in err


def test_main_with_debug_raises_original_error(tmp_path: Path) -> None:
    from mosaico_ingest.errors import ManifestError  # noqa: PLC0415 - as the command line does

    with pytest.raises(ManifestError):
        main(["--debug", str(tmp_path / "nowhere.yaml")])


def test_bag_unwritable_report_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text("bag: {path: data/run.mcap}\ntopics: [!/cam]\n")
    (tmp_path / "job.yaml").chmod(0o400)
    refused = "(Read-only file system|Permission denied)"
    with read_only(tmp_path):
        code, _, err = ingest("lint", "--fix", str(tmp_path / "job.yaml"))
        assert (code, bool(re.search(f"job.yaml: {refused}", err))) == (1, True)
        code, _, err = ingest("schema", "job", "--write", str(tmp_path / "schemas"))
        assert (code, bool(re.search(f"job.schema.json: cannot be written: {refused}", err))) == (1, True)


def test_bag_read_only_folder_exits_1(
    ingest: Ingest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = job(tmp_path, GOOD)
    with read_only(tmp_path):
        monkeypatch.chdir(tmp_path)  # what was entered before may still be written
        code, _, err = ingest(manifest)
    assert code == 1
    assert "mosaico" in err


@pytest.mark.parametrize("option", ["--report", "--metrics"])
def test_bag_report_is_folder_exits_before_ingestion(ingest: Ingest, tmp_path: Path, option: str) -> None:
    code, _, err = ingest(job(tmp_path, GOOD), option, ".")
    assert (code, err) == (2, "error: .: is a folder — name a file\n")
    assert not (tmp_path / "mosaico").exists()


def test_run_unwritable_output_keeps_other_outputs(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, out, err = ingest(job(tmp_path, GOOD), "--metrics", "file/x.prom", "--report", "run.json")
    assert code == 1
    assert "messages written" in out
    assert "file/x.prom: cannot be written: " in err
    assert (tmp_path / "run.json").exists()


def test_plan_unwritable_output_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = ingest("plan", job(tmp_path, GOOD), "--out", "file/plan.json")
    assert code == 1
    assert "file/plan.json: cannot be written: " in err
    assert ingest("plan", "job.yaml", "--out", ".")[0] == 2


def test_bag_damaged_recording_prints_unreadable_range_once(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(QUICKSTART.read_bytes()[:300_000])
    code, out, err = ingest("bag", "cut.mcap", "--name", "cut")
    assert code == 4
    assert err.count("without a footer") == 1
    assert "unreadable: at 43: the chunk is truncated" in err
    assert ", some unreadable, " in out


def test_run_batch_prints_number_of_skipped_recordings(ingest: Ingest, tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        (tmp_path / f"{name}.mcap").write_bytes(QUICKSTART.read_bytes())
    text = 'version: 1\nbag: {path: "*.mcap"}\nsequence: {if_exists: skip}\ntopics: [/battery]\n'
    assert "4 recordings, 0 failed, 40 messages written" in ingest(job(tmp_path, text))[1]
    _, out, err = ingest("job.yaml")
    assert "4 recordings, 0 failed, 4 skipped, 0 messages written" in out
    assert "a: skipped\n" in err


def test_inspect_recording_without_topics_prints_no_topics(ingest: Ingest, tmp_path: Path) -> None:
    with Writer(tmp_path / "none.bag"):
        pass
    first, *rest = ingest("inspect", "none.bag")[1].splitlines()
    assert (first, rest[-1]) == ("none.bag", "no topics")
    assert rest[0].startswith("ros1, ")
    assert rest[0].endswith(", 0 messages")


@pytest.mark.parametrize(
    ("settings", "place"),
    [
        ("sequence: {name: a/b}", "job.yaml:2:18: sequence name 'a/b' contains '/'"),
        ("sequence: {metadata: {a.b: 1}}", "job.yaml:2:22: metadata key 'a.b'"),
        ('topic_settings: {/imu: {rename: "/a b"}}', "job.yaml:2:33: topic name '/a b' contains ' '"),
        ("topic_settings: {/imu: {metadata: {a.b: 1}}}", "job.yaml:2:35: metadata key 'a.b'"),
    ],
)
def test_bag_invalid_sequence_name_exits_2(ingest: Ingest, tmp_path: Path, settings: str, place: str) -> None:
    code, _, err = ingest(job(tmp_path, f"bag: {{path: {QUICKSTART}}}\n{settings}\n"))
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"error: {place}")


def test_store_unknown_name_suggests_nearest(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "drive", "--topics", "gps/fx", "--topics", "imu")
    assert code == 3
    assert "no topic matches 'gps/fx', 'imu' — the nearest is /gps/fix, /imu; there are " in err
    err = ingest("bag", str(QUICKSTART), "--name", "drive", "--topics", "!/imu*", "--topics", "/x")[2]
    assert "the nearest" not in err
    ingest("bag", str(QUICKSTART), "--name", "drive", "--topics", "/imu")
    assert "the nearest is drive; there are drive\n" in ingest("store", "show", "drvie")[2]
    assert (
        "the nearest is /imu; there are /imu\n" in ingest("export", "drive", "--to", "x.mcap", "-t", "/iu")[2]
    )


def test_store_path_is_file_exits_1(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "drive", "--store", "file")
    assert code == 1
    assert "error: file: File exists — remove the file at this path, or choose another target.store\n" in err


def test_run_missing_adapter_file_is_reported_once(ingest: Ingest) -> None:
    ingest("bag", str(QUICKSTART), "--name", "drive", "--topics", "/imu")
    err = ingest("export", "drive", "--to", "x.mcap", "--adapter", "no.yaml")[2]
    assert err == "error: no.yaml: the adapter file cannot be read: No such file or directory\n"


def test_main_manifest_after_options_runs(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest("-q", "--jobs", "2", job(tmp_path, GOOD)) == (0, "", "")


@pytest.mark.parametrize("name", ["my drive.mcap", "."])
def test_main_recording_instead_of_manifest_suggests_bag_and_init(ingest: Ingest, name: str) -> None:
    code, _, err = ingest(name)
    assert code == 2
    assert f"`ingest init {name if name == '.' else repr(name)}`" in err


def test_run_empty_shard_exits_0_with_note(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "--shard", "2/2") == (
        0,
        "",
        "shard 2/2 is empty: the job has 1 recording\n",
    )


def test_keys_missing_file_or_past_expiry_exits_2(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest("keys", "ls")[0] == 2
    new = ("keys", "new", "--permission", "read", "--expires")
    assert "is in the past" in ingest(*new, "2020-01-01T00:00:00Z")[2]
    assert "has no time zone" in ingest(*new, "2999-01-01")[2]
    assert ingest(*new, "2999-01-01T00:00:00Z")[0] == 0
    assert "expires 2999" in ingest("keys", "ls")[1]
    assert (
        ingest("keys", "ls", "--api-keys", ".")[2]
        == "error: .: the key file cannot be read: Is a directory\n"
    )
    assert "api_keys.json/x: the key file cannot be " in ingest(*new[:-1], "--api-keys", "api_keys.json/x")[2]
    ring = tmp_path / "api_keys.json"
    ring.write_text(ring.read_text().replace("2999", "2020"))
    assert "expired 2020" in ingest("keys", "ls")[1]


def test_bag_unreadable_certificate_names_file(ingest: Ingest) -> None:
    code, _, err = ingest("serve", "--tls-cert", "no.pem", "--tls-key", "no.pem")
    assert (code, err) == (1, "error: no.pem: the PEM file cannot be read: No such file or directory\n")


def test_expand_undecodable_file_name_with_strict_stdout_succeeds(tmp_path: Path) -> None:
    name = os.fsdecode(b"job\xff.yaml")
    (tmp_path / name).write_text(
        "version: 1\nbag: {path: '{a}.mcap'}\nsequence: {name: s}\nmatrix: {a: [x, y]}\n"
    )
    result = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", "expand", name],
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, b"")
    assert rb"# job\udcff.yaml: a=x" in result.stdout


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (("inspect", str(QUICKSTART)), 0),
        (("--help",), 0),
        (("schema", "job"), 0),
        (("bag", "cut.mcap", "--name", "cut"), 4),
    ],
)
@pytest.mark.slow
def test_run_closed_pipe_keeps_exit_code(arguments: tuple[str, ...], code: int, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(QUICKSTART.read_bytes()[:300_000])
    command = [sys.executable, "-m", "mosaico_ingest", *arguments]
    with subprocess.Popen(  # noqa: S603 - our own command
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        running.stdout.close()
        assert running.wait(60) == code
        assert running.stderr is not None
        assert "Traceback" not in running.stderr.read()


@pytest.mark.slow
def test_run_closed_stdout_keeps_exit_code(tmp_path: Path) -> None:
    command = f"{sys.executable} -m mosaico_ingest inspect {QUICKSTART} >&-"
    result = subprocess.run(  # noqa: S602 - our own command
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert (result.returncode, result.stderr) == (0, "")
