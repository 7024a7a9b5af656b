"""Measure whether costs are proportional: a part of a recording, adapters in Python, and commands on recordings of any length.

    python benchmarks/proportion.py [--runs 3] [--data FOLDER]

Each figure describes a complete process. Shares refer to CPU time, which other load affects less than wall time, minus the
CPU time of a run over one millisecond.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from measure import Sample, run, typical
from workloads import BY_NAME

HERE = Path(__file__).parent
INGEST = (sys.executable, "-m", "mosaico_ingest")
SELECTED = {
    "telemetry-1200s": "/battery",
    "cameras": "/cam/left/camera_info",
    "mixed-100s": "/gps/fix",
    "mixed-sqlite-100s": "/gps/fix",
    "mixed-ros1-100s": "/gps/fix",
}
"""The rarest topic of each recording."""
INSPECTED = ("telemetry-30s", "telemetry", "telemetry-1200s")

ADAPTERS = {
    "from the catalog": "",
    "Python, from_batch": """
    @classmethod
    def from_batch(cls, rows):
        import pyarrow as pa
        return pa.StructArray.from_arrays([rows.field("data")], fields=[pa.field("data", pa.float64(), False)])
""",
    "Python, from_dict": """
    @classmethod
    def from_dict(cls, ros_data):
        return Floating64(data=ros_data["data"])
""",
}
ADAPTER = """from mosaico_ingest import ROSAdapterBase, register_default_adapter
from mosaico_ingest.ontology import Floating64


class LoadAdapter(ROSAdapterBase[Floating64]):
    ros_msgtype = "std_msgs/msg/Float64"
    __mosaico_ontology_type__ = Floating64
"""


class Jobs:
    """Runs of manifests over one recording at a time."""

    def __init__(self, folder: Path, runs: int) -> None:
        self.folder = folder
        self.runs = runs

    def run_manifest(self, recording: Path, *, bag: str = "", rest: str = "") -> Sample:
        """Return the median figures of a manifest; `bag` is inserted into its bag section, `rest` at its end."""
        job, store = self.folder / "job.yaml", self.folder / "store"
        job.write_text(
            f"version: 1\nbag: {{path: '{recording}'{bag}}}\nsequence: {{name: run}}\ntarget: {{store: '{store}'}}\n{rest}"
        )
        samples: list[Sample] = []
        for _ in range(self.runs):
            shutil.rmtree(store, ignore_errors=True)
            samples.append(run([*INGEST, job, "-q"]))
        return typical(samples)

    def print_shares(self, name: str, recording: Path, topic: str) -> None:
        """Print the cost of 1 % of the time and of one rare topic, relative to the complete recording."""
        length = BY_NAME[name].seconds
        start = self.run_manifest(recording, bag=window(length, 0.001 / length)).cpu_s
        complete = self.run_manifest(recording).cpu_s - start
        short = self.run_manifest(recording, bag=window(length, 0.01)).cpu_s - start
        rare = self.run_manifest(recording, rest=f'topics: ["{topic}"]\n').cpu_s - start
        print(
            f"| {name} | {start:.2f} s | {complete:.2f} s | {100 * short / complete:.1f} % | {100 * rare / complete:.0f} % |",
            flush=True,
        )

    def print_adapters(self, recording: Path) -> None:
        """Print the time of each type of adapter for the same messages."""
        for name, methods in ADAPTERS.items():
            rest = 'topics: ["/load"]\n'
            if methods:
                (self.folder / "load_adapter.py").write_text(ADAPTER + methods)
                rest += "adapters: {load: ['load_adapter.py:LoadAdapter']}\n"
            print(f"| {name} | {self.run_manifest(recording, rest=rest).wall_s:.2f} s |", flush=True)


def window(length: float, share: float) -> str:
    """Return the key `time` of a manifest for a share of a recording, starting in its middle."""
    return f", time: {{start: +{length / 2:g}s, end: +{length / 2 + length * share:g}s}}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--data", type=Path, default=HERE / "data")
    arguments = parser.parse_args()
    data: Path = arguments.data
    data.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=data) as folder:
        jobs = Jobs(Path(folder), arguments.runs)
        print(
            "| recording | start-up (CPU) | remainder (CPU) | 1 % of its time | one rare topic |\n|---|---:|---:|---:|---:|"
        )
        for name, topic in SELECTED.items():
            jobs.print_shares(name, BY_NAME[name].path(data), topic)
        print("\n| adapter of 300,000 numbers | time of the run |\n|---|---:|")
        jobs.print_adapters(BY_NAME["telemetry"].path(data))
        print("\n| recording | `ingest inspect` | `ingest plan` |\n|---|---:|---:|")
        for name in INSPECTED:
            recording = BY_NAME[name].path(data)
            job = Path(folder) / "inspect.yaml"
            job.write_text(f"version: 1\nbag: {{path: '{recording}'}}\n")
            seconds = [
                typical([run([*INGEST, *rest]) for _ in range(arguments.runs)]).wall_s
                for rest in (["inspect", recording], ["plan", job])
            ]
            print(f"| {name} | {seconds[0]:.2f} s | {seconds[1]:.2f} s |", flush=True)


if __name__ == "__main__":
    main()
