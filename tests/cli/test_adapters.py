"""`ingest adapters`: list, show, explain, test and init."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from mosaico_ingest.adapters.bridge import _entry_point_adapters
from mosaico_ingest.adapters.builtin import BUILTIN, BY_NAME
from mosaico_ingest.adapters.standalone import DefinitionFinder
from mosaico_ingest.cli.app import main
from mosaico_ingest.services.adapters import explain_adapter

Ingest = Callable[..., tuple[int, str, str]]
ROOT = Path(__file__).resolve().parents[2]
JOB = ROOT / "configs" / "quickstart.yaml"
BAG = ROOT / "configs" / "quickstart" / "drive.mcap"
PACK = ROOT / "configs" / "quickstart" / "adapters" / "battery_pack.yaml"
PACKAGE = """
from mosaico_ingest import ROSAdapterBase, Serializable


class FlatImu(Serializable):
    x: float


class FlatImuAdapter(ROSAdapterBase[FlatImu]):
    ros_msgtype = "sensor_msgs/msg/Imu"
    __mosaico_ontology_type__ = FlatImu

    @classmethod
    def from_dict(cls, ros_data):
        return FlatImu(x=ros_data["linear_acceleration"]["x"])


OFFERED = [FlatImuAdapter]
"""
MESSAGES = ROOT / "configs" / "quickstart" / "acme_msgs"


@pytest.fixture
def ingest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Ingest:
    """Run `ingest adapters …` in an empty folder; return exit code, output and errors."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as leave:
            main(["adapters", *map(str, arguments)])
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        return int(leave.value.code or 0), out, err

    return run


def test_list_without_filter_lists_every_built_in_adapter(ingest: Ingest) -> None:
    code, out, _ = ingest("list", "--json")
    assert code == 0
    assert [one["name"] for one in json.loads(out)] == [builtin.name for builtin in BUILTIN]
    assert "by override" in ingest("list")[1]


@pytest.mark.parametrize("glob", ["sensor_msgs/msg/Imu", "sensor_msgs/Im*", "Imu"])
def test_list_with_type_lists_adapters_of_that_type(ingest: Ingest, glob: str) -> None:
    names = [one["name"] for one in json.loads(ingest("list", "--type", glob, "--json")[1])]
    assert "IMUAdapter" in names
    assert "PoseAdapter" not in names


def test_list_with_unknown_type_exits_3(ingest: Ingest) -> None:
    code, out, err = ingest("list", "--type", "nowhere_msgs/*")
    assert (code, out) == (3, "")
    assert "no adapter takes 'nowhere_msgs/*'" in err


def test_show_built_in_adapter_prints_its_file(ingest: Ingest) -> None:
    assert ingest("show", "IMUAdapter")[1] == BY_NAME["IMUAdapter"].path.read_text()
    assert ingest("show", PACK)[1] == PACK.read_text()


def test_show_unknown_adapter_suggests_nearest(ingest: Ingest) -> None:
    code, _, err = ingest("show", "ImuAdaptr")
    assert code == 1
    assert "did you mean" in err


def test_explain_built_in_adapter_lists_every_column() -> None:
    types = DefinitionFinder()
    for builtin in BUILTIN:
        explanation = explain_adapter(builtin.name, types).description
        struct = builtin.mapping.ontology.struct
        origins = {column.name: column.origin for column in explanation.columns}
        assert explanation.ontology == builtin.tag
        assert {field.name for field in struct} <= origins.keys()
        assert all(origins[field.name] is not None for field in struct if not field.nullable)


def test_explain_type_explains_its_default_adapter(ingest: Ingest) -> None:
    output = json.loads(ingest("explain", "sensor_msgs/PointCloud2", "--json")[1])
    assert output["description"]["name"] == "PointCloudAdapter"
    assert output["why"] == "built-in for sensor_msgs/msg/PointCloud2"
    assert "LidarAdapter" in output["others"]
    assert "Unmodeled" in ingest("explain", "std_msgs/msg/ColorRGBA")[1]


def test_explain_protobuf_type_explains_its_default_adapter(ingest: Ingest) -> None:
    output = json.loads(ingest("explain", "foxglove.LocationFix", "--json")[1])
    assert output["why"] == "built-in for foxglove.LocationFix"
    assert output["unread"] == ["heading"]
    assert "Unmodeled" in ingest("explain", "acme.Speed")[1]


def test_explain_variant_type_lists_its_additional_columns(ingest: Ingest) -> None:
    output = json.loads(ingest("explain", "geometry_msgs/msg/PoseStamped", "--json")[1])
    origins = {column["name"]: column["origin"] for column in output["description"]["columns"]}
    assert origins["header"] == "header"
    assert origins["covariance"] is None
    assert output["description"]["takes"]["geometry_msgs/msg/PoseWithCovarianceStamped"] == "pose.pose"


def test_explain_adapter_lists_fields_without_column(ingest: Ingest) -> None:
    _, out, _ = ingest("explain", PACK, "--msg-dir", MESSAGES)
    assert "current_ma" in out
    assert "left out" not in out
    text = PACK.read_text().replace("  current: -current_ma / 1000\n", "").replace("current: -0.5, ", "")
    Path("less.yaml").write_text(text)
    assert "fields without a column: current_ma" in ingest("explain", "less.yaml", "--msg-dir", MESSAGES)[1]


def test_explain_job_lists_adapter_and_reason_per_topic(ingest: Ingest) -> None:
    topics = {one["topic"]: one for one in json.loads(ingest("explain", "--job", JOB, "--json")[1])}
    assert topics["/battery"]["adapter"] == "BatteryPackAdapter"
    assert topics["/battery"]["why"] == "loaded from quickstart/adapters/battery_pack.yaml"
    assert topics["/camera/image_raw"]["adapter"] == ""
    assert "`topics`" in topics["/camera/image_raw"]["why"]


def test_explain_bag_lists_adapter_and_reason_per_topic(ingest: Ingest) -> None:
    code, out, _ = ingest("explain", "--bag", BAG)
    assert code == 0
    assert "built-in for sensor_msgs/msg/Imu" in out
    assert "no adapter takes acme_msgs/msg/BatteryPack" in out


def test_test_all_built_in_adapters_passes(ingest: Ingest) -> None:
    code, out, _ = ingest("test", "--all")
    assert code == 0
    assert f"{len(BUILTIN)} adapters" in out


def test_test_failing_test_prints_location_and_actual_value(ingest: Ingest) -> None:
    Path("pack.yaml").write_text(PACK.read_text().replace("voltage: 12.0", "voltage: 13.0"))
    code, out, _ = ingest("test", "pack.yaml", "--msg-dir", MESSAGES)
    assert code == 1
    assert "pack.yaml:23: discharging" in out
    assert "voltage: expected 13.0, got 12.0" in out
    assert "0 of 1 tests passed" in out


def test_test_name_with_control_characters_is_escaped(ingest: Ingest) -> None:
    text = PACK.read_text().replace("voltage: 12.0", "voltage: 13.0")
    Path("pack.yaml").write_text(text.replace("name: discharging", r'name: "\e]0;owned\a:skull:"'))
    _, out, _ = ingest("test", "pack.yaml", "--msg-dir", MESSAGES)
    assert "\x1b" not in out
    assert ":skull:" in out


def test_test_mismatched_adapter_prints_source_excerpt(ingest: Ingest) -> None:
    Path("pack.yaml").write_text(PACK.read_text().replace("soc / 100", "charge_left / 100"))
    code, out, _ = ingest("test", "pack.yaml", "--msg-dir", f"acme_msgs={MESSAGES}")
    assert code == 1
    assert "pack.yaml:12:15" in out
    assert "charge_left" in out


def test_test_with_recorded_message_passes(ingest: Ingest, tmp_path: Path) -> None:
    text = PACK.read_text()
    test = f"tests:\n  - name: recorded\n    given: {{bag: {BAG}, topic: /battery, index: 2}}\n    expect: {{serial_number: PK-0042}}\n"
    (tmp_path / "pack.yaml").write_text(text[: text.index("tests:")] + test)
    assert ingest("test", "pack.yaml", "--msg-dir", MESSAGES)[0] == 0
    (tmp_path / "pack.yaml").write_text(
        (tmp_path / "pack.yaml").read_text().replace("index: 2", "index: 99999")
    )
    code, out, _ = ingest("test", "pack.yaml", "--msg-dir", MESSAGES)
    assert code == 1
    assert "there is none at index 99999" in out


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package as an installer leaves it, which offers an adapter."""
    info = tmp_path / "site" / "acme_pkg-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-pkg\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[mosaico_ingest.adapters]\nimu = acme_pkg_for_tests:OFFERED\n")
    (info.parent / "acme_pkg_for_tests.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(info.parent)
    _entry_point_adapters.cache_clear()
    yield info
    sys.modules.pop("acme_pkg_for_tests", None)
    _entry_point_adapters.cache_clear()


@pytest.mark.usefixtures("package")
def test_installed_adapter_is_listed_and_usable_by_name(
    ingest: Ingest, capsys: pytest.CaptureFixture[str]
) -> None:
    listed = json.loads(ingest("list", "--type", "Imu", "--json")[1])
    assert listed[0]["name"] == "FlatImuAdapter"
    assert listed[0]["origin"] == "entry point imu of acme-pkg"
    assert "entry point imu of acme-pkg" in ingest("explain", "--bag", BAG)[1]
    assert "acme_pkg_for_tests.FlatImuAdapter.from_dict" in ingest("explain", "FlatImuAdapter")[1]
    job = f"version: 1\nbag: {{path: {BAG}}}\nsequence: {{name: s}}\ntopics: [/imu]\n"
    Path("job.yaml").write_text(job + "adapters: {override: {/imu: FlatImuAdapter}}\n")
    assert "override '/imu'" in ingest("explain", "--job", "job.yaml")[1]
    with pytest.raises(SystemExit):
        main(["lint", "job.yaml"])
    assert "unknown-adapter" not in capsys.readouterr().out


def test_list_broken_installed_package_names_package(ingest: Ingest, package: Path) -> None:
    (package / "entry_points.txt").write_text("[mosaico_ingest.adapters]\nimu = acme_pkg_for_tests:Gone\n")
    code, _, err = ingest("list")
    assert code == 1
    assert "acme-pkg" in err
    assert "Gone" in err


@pytest.mark.parametrize("ontology", [(), ("--ontology", "BatteryState")])
def test_init_with_recorded_message_passes_test_and_lint(
    ingest: Ingest, capsys: pytest.CaptureFixture[str], ontology: tuple[str, ...]
) -> None:
    draft = (
        "init",
        "acme_msgs/BatteryPack",
        "--bag",
        BAG,
        "--record",
        "/battery",
        *ontology,
        "-o",
        "draft.yaml",
    )
    assert ingest(*draft)[0] == 0
    assert "PK-0042" in Path("draft.yaml").read_text()
    assert ingest("test", "draft.yaml")[0] == 0
    with pytest.raises(SystemExit) as leave:
        main(["lint", "draft.yaml"])
    assert not leave.value.code, capsys.readouterr().out
    assert ingest(*draft)[0] == 2  # it is there already


@pytest.mark.parametrize("topic", ["/imu", "/lidar/points", "/odom", "/camera/image_raw/compressed"])
def test_init_with_large_message_refers_to_recording(ingest: Ingest, topic: str) -> None:
    topics = json.loads(ingest("explain", "--bag", BAG, "--json")[1])
    chosen = next(one for one in topics if one["topic"] == topic)
    code, out, _ = ingest(
        "init", chosen["msgtype"], "--bag", BAG, "--record", topic, "--ontology", chosen["ontology"]
    )
    assert code == 0
    Path("draft.yaml").write_text(out)
    assert ingest("test", "draft.yaml")[0] == 0


def test_init_unknown_type_lists_searched_sources(ingest: Ingest) -> None:
    code, _, err = ingest("init", "nosuch_msgs/Type")
    assert code == 1
    assert "searched" in err
    code, _, err = ingest("init", "acme_msgs/BatteryPack", "--bag", BAG, "--record", "/imu")
    assert code == 1
    assert "the topic has the type sensor_msgs/msg/Imu" in err


@pytest.mark.parametrize(
    "arguments", [("explain",), ("test",), ("test", "IMUAdapter", "--all"), ("init", "a/B", "--record", "/x")]
)
def test_adapters_ambiguous_arguments_exit_2(ingest: Ingest, arguments: tuple[str, ...]) -> None:
    assert ingest(*arguments)[0] == 2


def test_try_shows_message_and_rows_side_by_side(ingest: Ingest) -> None:
    code, out, _ = ingest("try", "IMUAdapter", "--bag", BAG, "--topic", "/imu", "-n", 2)
    assert code == 0
    assert out.count("message ") >= 2
    assert "linear_acceleration.x" in out
    assert "acceleration.x" in out.replace("linear_acceleration.x", "")
    assert "2 messages: 2 written, 0 dropped, 0 rejected" in out


def test_try_json_has_rows_rejections_and_dropped_messages(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "cells.yaml").write_text(
        """version: 1
adapter: CellsAdapter
ros_type: acme_msgs/msg/BatteryPack
parameters: {least: 0}
drop_when: message.log_time % 2 == 1
rows: filter(cells, voltage_mv >= least)[]
ontology: {tag: Cell, fields: {millivolts: uint16}}
fields: {millivolts: voltage_mv}
"""
    )
    arguments = ("try", "cells.yaml", "--bag", BAG, "--topic", "/battery", "-n", 3, "--json")
    code, out, _ = ingest(*arguments)
    tried = json.loads(out)
    assert code == 0
    assert [one["index"] for one in tried] == [0, 1, 2]
    for one in tried:
        voltages = [cell["voltage_mv"] for cell in one["message"]["cells"]]
        expected = [] if one["dropped"] else voltages
        assert [row["millivolts"] for row in one["rows"][""]] == expected
    code, out, _ = ingest(*arguments, "--with", "least=65535")
    assert {one["dropped"] for one in json.loads(out)} <= {"rows", "drop_when"}
    assert ingest(*arguments, "--with", "lest=1")[0] == 1


def test_try_rejected_message_exits_with_4(ingest: Ingest, tmp_path: Path) -> None:
    (tmp_path / "bad.yaml").write_text(
        "version: 1\nadapter: BadAdapter\nros_type: acme_msgs/msg/BatteryPack\n"
        "ontology: {tag: Bad, fields: {n: int8}}\nfields: {n: cast(voltage_mv)}\n"
    )
    code, out, _ = ingest("try", "bad.yaml", "--bag", BAG, "--topic", "/battery", "-n", 1)
    assert code == 4
    assert "[out-of-range]" in out


def test_init_with_job_keeps_lists_of_structs_and_names_the_schema(ingest: Ingest, tmp_path: Path) -> None:
    out = tmp_path / "pack.yaml"
    code, _, _ = ingest("init", "acme_msgs/BatteryPack", "--job", JOB, "--record", "/battery", "-o", out)
    text = out.read_text()
    assert code == 0
    assert text.startswith("# yaml-language-server: $schema=adapter.schema.json\n")
    assert "      type: list\n      fields:\n        voltage_mv: uint16\n" in text
    assert ingest("test", out)[0] == 0
    assert ingest("init", "acme_msgs/BatteryPack", "--job", JOB, "--bag", BAG)[0] == 2
