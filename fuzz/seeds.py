"""The seeds of the fuzzing targets: small valid inputs, from which a fuzzer derives others.

`python fuzz/seeds.py DIR` writes them into a folder for each target, as the corpus of a long run.
"""

from __future__ import annotations

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
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


def seeds() -> dict[str, list[bytes]]:
    """Return the seeds of each target."""
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


def main() -> None:
    """Write the seeds into the folder that the command line names."""
    for target, contents in seeds().items():
        folder = Path(sys.argv[1], target)
        folder.mkdir(parents=True, exist_ok=True)
        for number, content in enumerate(contents):
            (folder / f"seed-{number}").write_bytes(content)


if __name__ == "__main__":
    main()
