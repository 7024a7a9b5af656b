"""The sources of definitions and their precedence."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from rosbags.typesys import Stores as RosbagsStores
from rosbags.typesys import get_typestore

from mosaico_ingest.errors import BagError
from mosaico_ingest.job.values import Stores
from mosaico_ingest.rosbag.definitions.model import Definition, Embedded, Source, normalize_msgtype
from mosaico_ingest.rosbag.definitions.registry import ROSTypeRegistry, TypeResolver, ros_version

BAR = "=" * 80


def embedded(text: str, encoding: str = "ros2msg") -> Embedded:
    return Embedded(encoding, text)


def resolve(resolver: TypeResolver, name: str, text: str | None = None, version: int = 2) -> Definition:
    return resolver.resolve(name, None if text is None else embedded(text), ros_version=version)


class TestNames:
    @pytest.mark.parametrize(
        ("name", "expected"),
        [
            ("std_msgs/String", "std_msgs/msg/String"),
            ("std_msgs/msg/String", "std_msgs/msg/String"),
            ("std_msgs::msg::dds_::String_", "std_msgs/msg/String"),
            ("roslib/Header", "std_msgs/msg/Header"),
            ("example_interfaces/srv/AddTwoInts_Event", "example_interfaces/srv/AddTwoInts_Event"),
            ("Vec3", "Vec3"),
        ],
    )
    def test_normalize_msgtype_maps_notations_to_one_name(self, name: str, expected: str) -> None:
        assert normalize_msgtype(name) == expected


class TestOrder:
    def test_resolve_prefers_recording(self) -> None:
        resolver = TypeResolver(Stores.ROS2_HUMBLE, types={"std_msgs/msg/String": "int8 custom"})
        definition = resolve(resolver, "std_msgs/String", "int8 embedded")
        assert (definition.message.fields[0].name, definition.source) == ("embedded", Source.BAG)

    def test_resolve_prefers_custom_types_to_distro(self) -> None:
        resolver = TypeResolver(Stores.ROS2_HUMBLE, types={"std_msgs/msg/String": "int8 custom"})
        definition = resolve(resolver, "std_msgs/msg/String")
        assert (definition.message.fields[0].name, definition.source) == ("custom", Source.CUSTOM)

    def test_resolve_searches_each_nested_type(self) -> None:
        resolver = TypeResolver(Stores.ROS2_HUMBLE, types={"mine/msg/Part": "float32 size"})
        definition = resolve(
            resolver,
            "mine/msg/Whole",
            "mine/Part part\nPart[] parts\ngeometry_msgs/Point where\nHeader header",
        )
        assert set(definition.types) == {
            "mine/msg/Whole", "mine/msg/Part", "geometry_msgs/msg/Point", "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
        }  # fmt: skip

    @pytest.mark.parametrize("version", [1, 2])
    def test_resolve_complete_text_shares_definition_between_resolvers(self, version: int) -> None:
        text = f"Header header\nPart[] parts\n{BAR}\nMSG: mine/Part\nfloat32 size\n{BAR}\nMSG: std_msgs/Header\nstring frame_id"
        shared = resolve(TypeResolver(), "mine/msg/Whole", text, version)
        assert resolve(TypeResolver(), "mine/msg/Whole", text, version) is shared
        other = TypeResolver(
            types={"other/msg/Unused": "int8 x"}
        )  # with own types, nested types are searched individually
        assert resolve(other, "mine/msg/Whole", text, version) == shared

    def test_resolve_incomplete_text_uses_custom_type_of_own_resolver(self) -> None:
        sizes = ("float32 size", "float64 size")
        resolvers = [TypeResolver(types={"mine/msg/Part": size}) for size in sizes]
        definitions = [resolve(resolver, "mine/msg/Whole", "mine/Part part") for resolver in resolvers]
        assert [each.types["mine/msg/Part"].fields[0].type for each in definitions] == ["float32", "float64"]

    def test_resolve_keeps_definitions_of_connections_apart(self) -> None:
        resolver = TypeResolver()
        first, second = resolve(resolver, "a/msg/B", "int8 x"), resolve(resolver, "a/msg/B", "int16 x")
        assert (first.message.fields[0].type, second.message.fields[0].type) == ("int8", "int16")

    def test_resolve_header_of_package_in_ros2_only(self) -> None:
        text = f"Header header\n{BAR}\nMSG: own/Header\nint8 x\n"
        assert resolve(TypeResolver(), "own/msg/T", text).message.fields[0].type == "own/msg/Header"
        ros1 = TypeResolver().resolve("own/T", Embedded("ros1msg", text), ros_version=1)
        assert [f.name for f in ros1.types["std_msgs/msg/Header"].fields] == ["seq", "stamp", "frame_id"]

    def test_resolve_service_event_finds_its_parts(self) -> None:
        text = (
            f"service_msgs/ServiceEventInfo info\nexample_interfaces/AddTwoInts_Request[<=1] request\n{BAR}\n"
            f"MSG: service_msgs/ServiceEventInfo\nuint8 event_type\n{BAR}\nMSG: example_interfaces/srv/AddTwoInts_Request\nint64 a\n"
        )
        definition = resolve(TypeResolver(), "example_interfaces/srv/AddTwoInts_Event", text)
        assert definition.message.fields[1].type == "example_interfaces/srv/AddTwoInts_Request"

    def test_resolve_service_event_from_srv_text(self) -> None:
        text = f"int64 a\nThing thing\n---\nint64 sum\n{BAR}\nMSG: mine/Thing\nint8 x\n"
        definition = resolve(TypeResolver(), "mine/srv/Add_Event", text)
        assert [(f.name, f.type, f.size) for f in definition.message.fields] == [
            ("info", "service_msgs/msg/ServiceEventInfo", 0),
            ("request", "mine/srv/Add_Request", 1),
            ("response", "mine/srv/Add_Response", 1),
        ]
        assert [f.type for f in definition.types["mine/srv/Add_Request"].fields] == [
            "int64",
            "mine/msg/Thing",
        ]

    def test_resolve_empty_text_is_empty_type_unless_known(self) -> None:
        assert resolve(TypeResolver(), "mine/msg/Signal", "").message.fields == ()
        for text in ("", "# a placeholder\n"):
            assert resolve(TypeResolver(), "std_msgs/msg/String", text).message.fields[0].name == "data"
        with pytest.raises(BagError, match="mine/msg/Signal is not known"):
            TypeResolver().resolve("mine/msg/Signal", Embedded("unknown", ""), ros_version=2)


class TestWithoutADistro:
    def test_resolve_without_distro_uses_common_type_with_finding(self) -> None:
        resolver = TypeResolver()
        assert resolve(resolver, "geometry_msgs/msg/Pose").source is Source.DISTRO
        (finding,) = resolver.findings
        assert "geometry_msgs/msg/Pose" in finding.message

    def test_findings_about_omits_other_types(self) -> None:
        resolver = TypeResolver()
        for name in ("geometry_msgs/msg/Point", "std_msgs/msg/String"):
            resolve(resolver, name)
        (finding,) = resolver.findings_about({"geometry_msgs/msg/Point"})
        assert finding.message.endswith(": geometry_msgs/msg/Point")
        assert resolver.findings_about(set()) == ()

    def test_resolve_without_distro_empty_type_has_no_finding(self) -> None:
        resolver = TypeResolver()
        assert resolve(resolver, "std_msgs/msg/Empty", "").message.fields == ()
        assert resolver.findings == ()

    def test_resolve_without_definitions_assumes_distros_before_iron(self) -> None:
        resolver = TypeResolver()
        assert len(resolve(resolver, "sensor_msgs/msg/Range").message.fields) == 6
        assert any("until Humble" in finding.message for finding in resolver.findings)
        with pytest.raises(BagError, match="not known"):
            resolve(resolver, "sensor_msgs/msg/Range", "")

    @pytest.mark.promise("db3-needs-distro")
    def test_resolve_without_distro_ambiguous_type_raises(self) -> None:
        with pytest.raises(BagError, match=r"not known.*searched.*set ros_distro"):
            resolve(TypeResolver(), "rcl_interfaces/msg/ParameterDescriptor")

    def test_resolve_unknown_type_raises_with_searched_places(self) -> None:
        with pytest.raises(
            BagError, match=r"mine/msg/X is not known .* searched: the recording.*custom_msgs"
        ):
            resolve(TypeResolver(), "mine/msg/X")

    def test_resolve_unknown_nested_type_raises_with_field(self) -> None:
        with pytest.raises(
            BagError, match=r"^mine/msg/X\.part: the definition of mine/msg/Part is not known"
        ):
            resolve(TypeResolver(), "mine/msg/X", "Part part")

    def test_resolve_distro_of_other_ros_version_raises(self) -> None:
        with pytest.raises(BagError, match="the recording is ROS 2, ros_distro is ros1_noetic"):
            resolve(TypeResolver(Stores.ROS1_NOETIC), "std_msgs/msg/Header")


class TestRefusals:
    def test_resolve_invalid_embedded_text_raises(self) -> None:
        resolver = TypeResolver()
        with pytest.raises(BagError, match="is invalid"):
            resolve(resolver, "mine/msg/X", "no field here!")
        assert resolve(resolver, "mine/msg/Y", "int8 x").message.fields

    def test_resolve_custom_type_replaces_invalid_embedded_text(self) -> None:
        resolver = TypeResolver(types={"mine/msg/X": "int8 good"})
        assert resolve(resolver, "mine/msg/X", "no field here!").source is Source.CUSTOM
        assert resolver.findings[0].rule == "unreadable-definition"

    @pytest.mark.parametrize(
        "text",
        [
            "X x",
            f"Y y\n{BAR}\nMSG: mine/Y\nX x",
            "".join(f"T{i + 1} a\nT{i + 1} b\n{BAR}\nMSG: mine/T{i + 1}\n" for i in range(30)) + "int8 x",
            "".join(f"T{i + 1} a\n{BAR}\nMSG: mine/T{i + 1}\n" for i in range(90)) + "int8 x",
            f"Y[1000000] y\n{BAR}\nMSG: mine/Y\nint8 x",
        ],
        ids=["itself", "in a circle", "exponential", "deep", "wide"],
    )
    def test_resolve_too_large_type_raises(self, text: str) -> None:
        with pytest.raises(BagError):
            resolve(TypeResolver(), "mine/msg/X", text)

    def test_resolve_other_schema_language_raises(self) -> None:
        with pytest.raises(BagError, match="'protobuf' is not a ROS definition"):
            TypeResolver().resolve("X", Embedded("protobuf", "syntax"), ros_version=2)


class TestCustomMessages:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        (tmp_path / "Part.msg").write_text("float32 size\n")
        return tmp_path

    def test_custom_msgs_accepts_folder_file_and_package(self, folder: Path) -> None:
        (folder / "msg").mkdir()
        (folder / "package").mkdir()
        (folder / "package" / "msg").mkdir()
        (folder / "package" / "msg" / "Part.msg").write_text("float32 size\n")
        for path in (folder, folder / "Part.msg", folder / "package"):
            assert (
                resolve(TypeResolver(custom=[("mine", path, None)]), "mine/msg/Part").source is Source.CUSTOM
            )

    def test_custom_msgs_do_not_affect_other_resolvers(self, folder: Path) -> None:
        TypeResolver(custom=[("mine", folder, None)])
        with pytest.raises(BagError):
            resolve(TypeResolver(), "mine/msg/Part")

    @pytest.mark.promise("custom-msgs-scope")
    def test_custom_msgs_of_another_distro_are_mentioned_only(self, folder: Path) -> None:
        resolver = TypeResolver("ros2_jazzy", [("mine", folder, "ros2_humble")])
        with pytest.raises(BagError, match="custom_msgs has it for ros2_humble only"):
            resolve(resolver, "mine/msg/Part")

    def test_custom_msgs_folder_without_definitions_raises(self, tmp_path: Path) -> None:
        with pytest.raises(BagError, match=r"has no \.msg or \.idl file"):
            TypeResolver(custom=[("mine", tmp_path, None)])

    def test_resolver_survives_pickling(self, folder: Path) -> None:
        ROSTypeRegistry.register("mine/msg/Other", "int8 x")
        try:
            resolver = TypeResolver(custom=[("mine", folder, None)])
        finally:
            ROSTypeRegistry.reset()
        twin = pickle.loads(pickle.dumps(resolver))  # noqa: S301 - pickled in this line
        assert resolve(twin, "mine/msg/Part") == resolve(resolver, "mine/msg/Part")
        assert resolve(twin, "mine/msg/Other").source is Source.CUSTOM


@pytest.mark.parametrize("distro", [Stores.ROS1_NOETIC, Stores.ROS2_FOXY, Stores.ROS2_HUMBLE, Stores.LATEST])
def test_flatten_standard_types_equal_rosbags_and_round_trip(distro: Stores) -> None:
    version = ros_version(distro)
    assert version
    store, resolver = get_typestore(RosbagsStores(distro.value)), TypeResolver(distro)
    for name in store.fielddefs:
        definition = resolver.resolve(name, None, ros_version=version)
        assert definition.text == store.generate_msgdef(name, ros_version=version)[0], name
        again = resolver.resolve(name, Embedded("ros2msg", definition.text), ros_version=version)
        assert {**again.types} == {**definition.types}, name
