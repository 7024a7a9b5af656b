"""Measure what the generated data files save: the time of small commands with each file, and with its source instead.

    python benchmarks/generated_files.py [--runs 9]

Each sample is a complete process; the figures are medians of user plus system CPU time, which other load affects less
than wall time. The runs alternate, so that all variants see the same load.
"""

from __future__ import annotations

import argparse
import os
import sqlite3
import statistics
import sys
import tempfile
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECORDING = ROOT / "configs" / "quickstart" / "drive.mcap"

WITHOUT: Mapping[str, str] = {
    "adapters/catalog.json": """
from mosaico_ingest.adapters import builtin
from mosaico_ingest.adapters.mapping.loader import load_adapter
builtin._load = lambda stem: load_adapter(builtin.CATALOG / f"{stem}.yaml", adapters=builtin.find_builtin)
""",
    "ontology/columns.json": """
from mosaico_ingest.ontology import registry
registry.builtin_type = lambda tag: registry.model(tag).ontology_type()
""",
    "rosbag/definitions/distros.json": """
from functools import cache
from rosbags.typesys import Stores, get_typestore
from mosaico_ingest.rosbag.definitions import distros
from mosaico_ingest.rosbag.definitions.rosbags_types import message_type
types_of = cache(lambda distro: get_typestore(Stores(distro)).fielddefs)
def distro_type(distro, name):
    types = types_of(distro.value)
    return message_type(name, types) if name in types else None
distros.distro_type = distro_type
""",
}
"""Code that replaces a file by its source: the YAML files, the models, and the type stores of rosbags."""

INSPECT = """
from mosaico_ingest.cli.app import main
main(["inspect", {recording!r}])
"""
JOB = """
from mosaico_ingest import ROSInjectionConfig, RosbagInjector
RosbagInjector(ROSInjectionConfig({recording!r}, "drive", store={store!r}{options})).run()
"""


def without_definitions(folder: Path) -> Path:
    """Return a `.db3` copy of standard topics of the recording, without definitions, as ROS 2 Humble writes them."""
    from mosaico_ingest.destinations.store import Store  # noqa: PLC0415 - only this process needs it
    from mosaico_ingest.export import export_sequence  # noqa: PLC0415 - only this process needs it

    store = folder / "source"
    code = JOB.format(recording=str(RECORDING), store=str(store), options=', topics=["/imu", "/gps/fix"]')
    run(code, folder)
    path = folder / "drive.db3"
    export_sequence(Store.open(store), "drive", path)
    with closing(sqlite3.connect(path)) as database:
        database.execute("DELETE FROM message_definitions")
        database.commit()
    return path


def run(code: str, folder: Path) -> float:
    """Run Python code in a process of its own and return its CPU time in ms."""
    output = os.open(folder / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    actions = [(os.POSIX_SPAWN_DUP2, output, 1), (os.POSIX_SPAWN_DUP2, output, 2)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = os.posix_spawn(sys.executable, [sys.executable, "-c", code], environment, file_actions=actions)
    os.close(output)
    _, status, usage = os.wait4(process, 0)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit((folder / "output.txt").read_text())
    return (usage.ru_utime + usage.ru_stime) * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=9)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        database = without_definitions(folder)
        tasks = {
            "`ingest inspect drive.mcap`": lambda _: INSPECT.format(recording=str(RECORDING)),
            "job of `drive.mcap`": lambda n: JOB.format(
                recording=str(RECORDING), store=f"{folder}/{n}", options=""
            ),
            "`ingest inspect` of a `.db3` without definitions": lambda _: INSPECT.format(
                recording=str(database)
            ),
        }
        print(f"| file | {' | '.join(tasks)} |")
        print(f"|---|{'---:|' * len(tasks)}")
        samples: dict[tuple[str, str], list[float]] = {}
        number = 0
        for _ in range(runs):
            for task, code in tasks.items():
                for file, patch in {"": "", **WITHOUT}.items():
                    number += 1
                    samples.setdefault((file, task), []).append(run(patch + code(number), folder))
        medians = {key: statistics.median(values) for key, values in samples.items()}
        for file in ("", *WITHOUT):
            title = f"without `{file}`" if file else "with all files"
            print(f"| {title} | {' | '.join(f'{medians[file, task]:.0f} ms' for task in tasks)} |")


if __name__ == "__main__":
    main()
