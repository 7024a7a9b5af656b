"""Compare `target.compression: fast` and `small`, and the lower bound of lossless compression.

    ./dev bench column_encodings RECORDING...

The bound is the entropy of the floating-point columns with few repeated values: sign, exponent and the first 8 bits of the
mantissa by their frequencies, and the other 44 bits without compression. The values of the benchmarks are independent random numbers, so
a smaller file is not possible.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from measure import Sample, run, typical

ROUNDS = 3
_DISTINCT_SHARE = 0.9
_MANTISSA_BITS, _COUNTED_BITS = 52, 8
ROW = "{:<24} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", metavar="RECORDING", nargs="+", type=Path)
    recordings: list[Path] = parser.parse_args().recordings
    print(ROW.format("recording", "source", "fast", "small", "bound", "small/src", "fast CPU", "small CPU"))
    for recording in recordings:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            rounds: dict[str, list[Sample]] = {"fast": [], "small": []}
            for _ in range(ROUNDS):  # alternating, since the speed of virtual machines varies
                for compression, samples in rounds.items():
                    samples.append(ingest(recording, folder, compression))
            files = {each: list((folder / each).rglob("*.parquet")) for each in rounds}
            sizes = {each: sum(path.stat().st_size for path in paths) for each, paths in files.items()}
            bound = sum(entropy_bytes(path) for path in files["fast"])
            source = recording.stat().st_size
            print(
                ROW.format(
                    recording.name[-24:],
                    f"{source / 1e6:.2f}",
                    f"{sizes['fast'] / 1e6:.2f}",
                    f"{sizes['small'] / 1e6:.2f}",
                    f"{bound / 1e6:.2f}",
                    f"{sizes['small'] / source:.2f}",
                    *(f"{typical(samples).cpu_s:.2f} s" for samples in rounds.values()),
                )
            )


def ingest(recording: Path, folder: Path, compression: str) -> Sample:
    manifest = {
        "bag": {"path": str(recording.resolve())},
        "sequence": {"name": "s", "if_exists": "replace"},
        "on_error": {"topic": "ignore"},
        "target": {"store": compression, "compression": compression},
    }
    path = folder / f"{compression}.yaml"
    path.write_text(json.dumps(manifest))
    return run([sys.executable, "-m", "mosaico_ingest", path, "-q"])


def entropy_bytes(path: Path) -> float:
    """Return the smallest possible size of the columns of 64-bit floats with few repeated values."""
    return sum(_entropy_bytes(values) for column in pq.read_table(path).columns for values in _floats(column))


def _floats(column: Any) -> Iterator[npt.NDArray[np.float64]]:  # noqa: ANN401 - any Arrow column
    values = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if isinstance(values, pa.ChunkedArray):  # pyarrow keeps large columns in chunks
        values = pa.concat_arrays(values.chunks)
    if pa.types.is_struct(values.type):
        for child in values.flatten():
            yield from _floats(child)
    elif pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type):
        yield from _floats(values.flatten())
    elif pa.types.is_float64(values.type):
        present = values.drop_null()
        if len(present) and pc.count_distinct(present).as_py() > _DISTINCT_SHARE * len(present):
            yield present.to_numpy()


def _entropy_bytes(values: npt.NDArray[np.float64]) -> float:
    kept = _MANTISSA_BITS - _COUNTED_BITS
    _, counts = np.unique(values.view(np.uint64) >> np.uint64(kept), return_counts=True)
    shares = counts / counts.sum()
    return len(values) * (float(-(shares * np.log2(shares)).sum()) + kept) / 8


if __name__ == "__main__":
    main()
