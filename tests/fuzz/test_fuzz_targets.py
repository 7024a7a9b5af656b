"""A short run of every fuzzing target with mutated seeds; the long run is guided by coverage."""

from __future__ import annotations

import importlib.util
import random
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
IDL = b"module pkg { module msg { struct Fuzzed { int32 a; sequence<double, 3> b; string<4> c; long d[3]; }; }; };"
MSG = (
    b"int32 a\nstring b\nfloat64[3] c\nuint8[] d\nOther[] o\n"
    + b"=" * 80
    + b"\nMSG: pkg/Other\nstring<=5 s\n"
)
BODY = b'{"locator": "a/b", "session_uuid": "x", "user_metadata": {"a": {"b": 1}}, "timestamp_ns_start": 3}'
METADATA = b"rosbag2_bagfile_information: {version: 5, relative_file_paths: [a.db3], message_count: 3}\n"
_FIELDS = (
    b"\4\0\0\0op=\2\7\0\0\0topic=a\6\0\0\0type=a\5\0\0\0md5=a\x08\0\0\0sec=\1\0\0\0\x09\0\0\0nsec=\2\0\0\0"
)
ROSRECORD = b"#ROSRECORD V1.2\n" + (bytes([len(_FIELDS)]) + b"\0\0\0" + _FIELDS + b"\2\0\0\0hi") * 20
NASTY = (
    b"\xff" * 4,
    b"\0" * 8,
    b"\x7f\xff\xff\xff",
    b"[" * 3000,
    b"&a [*a, *a]",
    b"9" * 5000,
    b"\x1b[2J",
    b"/../",
    b"!!python/object:os.system",
)


def _targets() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_targets", ROOT / "fuzz" / "targets.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TARGETS: dict[str, Callable[[bytes], None]] = _targets().TARGETS


def _seeds() -> dict[str, list[bytes]]:
    configs = ROOT / "configs"
    bag = (configs / "quickstart" / "drive.mcap").read_bytes()
    return {
        "recording": [
            bag[:20_000] + bag[-4_000:],
            b"#ROSBAG V2.0\n" + bytes(200),
            b"SQLite format 3\0" + bytes(4080),
            ROSRECORD,
        ],
        "definition": [
            b"\1" + MSG + b"\0\0\0\0\0\1\0\0" + b"\1\0\0\0" * 20,
            b"\2" + IDL,
            b"\0Header header\ntime t\n",
        ],
        "manifest": [path.read_bytes() for path in configs.glob("*.yaml")],
        "adapter": [path.read_bytes() for path in configs.glob("*/adapters/*.yaml")],
        "metadata": [METADATA],
        "wire": [BODY, b'{"action": "query", "response": {"items": []}}'],
    }


def _mutated(seed: bytes, rng: random.Random) -> bytes:
    content = bytearray(seed)
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(content) + 1)
        piece = rng.choice((*NASTY, rng.randbytes(rng.randrange(1, 9)), bytes(content[at : at + 40]) * 3))
        content[at : at + rng.choice((0, len(piece), 30))] = piece
    return bytes(content)


@pytest.mark.parametrize("name", TARGETS)
def test_fuzz_target_mutated_seed_is_accepted_or_refused(name: str) -> None:
    seeds = _seeds()[name]
    assert seeds
    rng = random.Random(name)  # noqa: S311 - test data
    TARGETS[name](b"")
    for seed in seeds:
        TARGETS[name](seed)
    for _ in range(120):
        TARGETS[name](_mutated(rng.choice(seeds), rng))
