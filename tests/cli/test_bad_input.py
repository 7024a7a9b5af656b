"""A user's mistake is one line that says what, where and what to do, with the documented exit code and no traceback."""

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


def test_a_missing_manifest(ingest: Ingest) -> None:
    code, _, err = ingest("nowhere.yaml")
    assert code == 2
    assert "nowhere.yaml" in err


def test_a_manifest_that_is_not_a_mapping(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, "- one\n- two\n"))
    assert code == 2
    assert "job.yaml:1:1" in err


def test_an_unknown_key_names_its_place_and_the_nearest_key(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, GOOD.replace("bag:", "bga:")))
    assert code == 2
    assert "job.yaml:2:1" in err
    assert "bag" in err


def test_a_missing_recording(ingest: Ingest, tmp_path: Path) -> None:
    code, _, err = ingest(job(tmp_path, "version: 1\nbag: {path: gone.mcap}\nsequence: {name: x}\n"))
    assert code == 3
    assert "gone.mcap" in err
    assert not (tmp_path / "mosaico").exists()


def test_an_empty_recording(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "empty.bag").touch()
    code, _, err = ingest("bag", "empty.bag", "--name", "x")
    assert code == 1
    assert "empty" in err


def test_something_that_is_no_recording(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "text.mcap").write_text("hello, this is no recording at all\n")
    code, _, err = ingest("bag", "text.mcap", "--name", "x")
    assert code == 1
    assert "text.mcap" in err


def test_a_directory_without_a_recording(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    code, _, err = ingest("bag", "empty", "--name", "x")
    assert code in {1, 3}
    assert "empty" in err


def test_a_store_that_cannot_be_written(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "mosaico").write_text("a file where the store should be")
    code, _, err = ingest(job(tmp_path, GOOD))
    assert code == 1
    assert "mosaico" in err


def test_a_store_of_a_newer_format(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "-q")[0] == 0
    with sqlite3.connect(tmp_path / "mosaico" / "catalog.sqlite") as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    code, _, err = ingest(job(tmp_path, GOOD.replace("good", "other")))
    assert code == 1
    assert "99" in err


def test_a_name_that_exists_leaves_the_old_sequence(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "-q")[0] == 0
    code, _, err = ingest(job(tmp_path, GOOD))
    assert code == 1
    assert "good" in err
    assert "if_exists" in err
    assert ingest("store", "show", "good")[0] == 0


def test_an_unknown_word_names_the_nearest_command(ingest: Ingest) -> None:
    code, _, err = ingest("inspct")
    assert code == 2
    assert "did you mean `ingest inspect`" in err


def test_metadata_that_is_not_an_object(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--metadata", "[1]")
    assert code == 2
    assert "--metadata" in err


def test_metadata_in_a_file_that_is_not_text(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "metadata.json").write_bytes(b"\x80\xff")
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--metadata", "metadata.json")
    assert code == 2
    assert "metadata.json: is not JSON" in err


def test_a_distro_that_does_not_exist(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--ros-distro", "ros2_hmble")
    assert code == 2
    assert "ros2_humble" in err


def test_a_log_level_that_does_not_exist(ingest: Ingest) -> None:
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "x", "--log", "LOUD")
    assert code == 2
    assert "LOUD" in err


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    from mosaico_ingest.errors import ManifestError  # noqa: PLC0415 - as the command line does

    with pytest.raises(ManifestError):
        main(["--debug", str(tmp_path / "nowhere.yaml")])


def test_a_file_that_may_not_be_written(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text("bag: {path: data/run.mcap}\ntopics: [!/cam]\n")
    (tmp_path / "job.yaml").chmod(0o400)
    refused = "(Read-only file system|Permission denied)"
    with read_only(tmp_path):
        code, _, err = ingest("lint", "--fix", str(tmp_path / "job.yaml"))
        assert (code, bool(re.search(f"job.yaml: {refused}", err))) == (1, True)
        code, _, err = ingest("schema", "job", "--write", str(tmp_path / "schemas"))
        assert (code, bool(re.search(f"job.schema.json: cannot be written: {refused}", err))) == (1, True)


def test_a_read_only_folder(ingest: Ingest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manifest = job(tmp_path, GOOD)
    with read_only(tmp_path):
        monkeypatch.chdir(tmp_path)  # what was entered before may still be written
        code, _, err = ingest(manifest)
    assert code == 1
    assert "mosaico" in err


@pytest.mark.parametrize("option", ["--report", "--metrics"])
def test_a_folder_in_place_of_a_file_to_write_is_said_before_anything_is_ingested(
    ingest: Ingest, tmp_path: Path, option: str
) -> None:
    code, _, err = ingest(job(tmp_path, GOOD), option, ".")
    assert (code, err) == (2, "error: .: is a folder — name a file\n")
    assert not (tmp_path / "mosaico").exists()


def test_a_file_that_cannot_be_written_costs_nothing_but_itself(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, out, err = ingest(job(tmp_path, GOOD), "--metrics", "file/x.prom", "--report", "run.json")
    assert code == 1
    assert "messages written" in out
    assert "file/x.prom: cannot be written: " in err
    assert (tmp_path / "run.json").exists()


def test_a_plan_that_cannot_be_written_is_said(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = ingest("plan", job(tmp_path, GOOD), "--out", "file/plan.json")
    assert code == 1
    assert "file/plan.json: cannot be written: " in err
    assert ingest("plan", "job.yaml", "--out", ".")[0] == 2


def test_what_a_damaged_recording_lost_is_said_once_with_its_place(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(QUICKSTART.read_bytes()[:300_000])
    code, out, err = ingest("bag", "cut.mcap", "--name", "cut")
    assert code == 4
    assert err.count("without a footer") == 1
    assert "unreadable: at 43: the chunk is truncated" in err
    assert ", some unreadable, " in out


def test_a_batch_says_how_many_recordings_were_skipped(ingest: Ingest, tmp_path: Path) -> None:
    for name in ("a", "b", "c", "d"):
        (tmp_path / f"{name}.mcap").write_bytes(QUICKSTART.read_bytes())
    text = 'version: 1\nbag: {path: "*.mcap"}\nsequence: {if_exists: skip}\ntopics: [/battery]\n'
    assert "4 recordings, 0 failed, 40 messages written" in ingest(job(tmp_path, text))[1]
    _, out, err = ingest("job.yaml")
    assert "4 recordings, 0 failed, 4 skipped, 0 messages written" in out
    assert "a: skipped\n" in err


def test_an_inspection_of_nothing_says_so(ingest: Ingest, tmp_path: Path) -> None:
    with Writer(tmp_path / "none.bag"):
        pass
    first, *rest = ingest("inspect", "none.bag")[1].splitlines()
    assert (first, rest[-1]) == ("none.bag", "no topics")
    assert rest[0].startswith("ros1, ")
    assert rest[0].endswith(", 0 messages")


@pytest.mark.parametrize(
    ("settings", "place"),
    [
        ("sequence: {name: a/b}", "job.yaml:2:18: sequence name 'a/b' has '/'"),
        ("sequence: {metadata: {a.b: 1}}", "job.yaml:2:22: metadata key 'a.b'"),
        ('topic_settings: {/imu: {rename: "/a b"}}', "job.yaml:2:33: topic name '/a b' has ' '"),
        ("topic_settings: {/imu: {metadata: {a.b: 1}}}", "job.yaml:2:35: metadata key 'a.b'"),
    ],
)
def test_a_name_that_the_platform_refuses_is_a_mistake_of_the_manifest(
    ingest: Ingest, tmp_path: Path, settings: str, place: str
) -> None:
    code, _, err = ingest(job(tmp_path, f"bag: {{path: {QUICKSTART}}}\n{settings}\n"))
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"error: {place}")


def test_a_name_that_is_not_there_is_answered_with_the_nearest(ingest: Ingest) -> None:
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


def test_a_file_where_the_store_should_be_is_said(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    code, _, err = ingest("bag", str(QUICKSTART), "--name", "drive", "--store", "file")
    assert code == 1
    assert "error: file: File exists — a file is in the way; choose another target.store\n" in err


def test_an_adapter_file_that_is_not_there_is_named_once(ingest: Ingest) -> None:
    ingest("bag", str(QUICKSTART), "--name", "drive", "--topics", "/imu")
    err = ingest("export", "drive", "--to", "x.mcap", "--adapter", "no.yaml")[2]
    assert err == "error: no.yaml: the adapter file cannot be read: No such file or directory\n"


def test_a_manifest_may_follow_the_options(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest("-q", "--jobs", "2", job(tmp_path, GOOD)) == (0, "", "")


@pytest.mark.parametrize("name", ["my drive.mcap", "."])
def test_a_recording_in_place_of_a_manifest_is_answered_with_what_takes_it(ingest: Ingest, name: str) -> None:
    code, _, err = ingest(name)
    assert code == 2
    assert f"`ingest init {name if name == '.' else repr(name)}`" in err


def test_a_shard_without_a_recording_says_so(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest(job(tmp_path, GOOD), "--shard", "2/2") == (
        0,
        "",
        "shard 2/2 is empty: the job has 1 recording\n",
    )


def test_keys_that_are_not_there_or_have_expired_are_said(ingest: Ingest, tmp_path: Path) -> None:
    assert ingest("keys", "ls")[0] == 2
    new = ("keys", "new", "--permission", "read", "--expires")
    assert "is in the past" in ingest(*new, "2020-01-01T00:00:00Z")[2]
    assert "has no time zone" in ingest(*new, "2999-01-01")[2]
    assert ingest(*new, "2999-01-01T00:00:00Z")[0] == 0
    assert "expires 2999" in ingest("keys", "ls")[1]
    assert ingest("keys", "ls", "--api-keys", ".")[2] == "error: .: cannot be read: Is a directory\n"
    assert "api_keys.json/x: cannot be " in ingest(*new[:-1], "--api-keys", "api_keys.json/x")[2]
    ring = tmp_path / "api_keys.json"
    ring.write_text(ring.read_text().replace("2999", "2020"))
    assert "expired 2020" in ingest("keys", "ls")[1]


def test_a_certificate_that_cannot_be_read_is_not_the_stores_fault(ingest: Ingest) -> None:
    code, _, err = ingest("serve", "--tls-cert", "no.pem", "--tls-key", "no.pem")
    assert (code, err) == (1, "error: no.pem: cannot be read: No such file or directory\n")


def test_a_manifest_of_any_name_is_expanded_where_output_is_strict(tmp_path: Path) -> None:
    name = os.fsdecode(b"job\xff.yaml")
    (tmp_path / name).write_text(
        "version: 1\nbag: {path: '{a}.mcap'}\nsequence: {name: s}\nmatrix: {a: [x, y]}\n"
    )
    done = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-m", "mosaico_ingest", "expand", name],
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert rb"# job\udcff.yaml: a=x" in done.stdout


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
def test_a_reader_that_leaves_early_changes_nothing(
    arguments: tuple[str, ...], code: int, tmp_path: Path
) -> None:
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
def test_output_that_is_closed_is_not_missed(tmp_path: Path) -> None:
    command = f"{sys.executable} -m mosaico_ingest inspect {QUICKSTART} >&-"
    done = subprocess.run(  # noqa: S602 - our own command
        command, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
