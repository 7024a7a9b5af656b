"""A short run of every fuzzing target with mutated seeds; the long run is guided by coverage."""

from __future__ import annotations

import importlib.util
import random
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]
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


def _module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"fuzz_{name}", ROOT / "fuzz" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TARGETS: dict[str, Callable[[bytes], None]] = _module("targets").TARGETS
SEEDS: dict[str, list[bytes]] = _module("seeds").seeds()
SECONDS = 2.0
"""Duration of the longer run of each target."""


def _mutated(seed: bytes, rng: random.Random) -> bytes:
    content = bytearray(seed)
    for _ in range(rng.randrange(1, 5)):
        at = rng.randrange(len(content) + 1)
        piece = rng.choice((*NASTY, rng.randbytes(rng.randrange(1, 9)), bytes(content[at : at + 40]) * 3))
        content[at : at + rng.choice((0, len(piece), 30))] = piece
    return bytes(content)


@pytest.mark.parametrize("name", TARGETS)
def test_fuzz_target_mutated_seed_is_accepted_or_refused(name: str) -> None:
    seeds = SEEDS[name]
    assert seeds
    rng = random.Random(name)  # noqa: S311 - test data
    TARGETS[name](b"")
    for seed in seeds:
        TARGETS[name](seed)
    for _ in range(120):
        TARGETS[name](_mutated(rng.choice(seeds), rng))


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_fuzz_target_repeatedly_mutated_seed_is_accepted_or_refused(name: str) -> None:
    rng = random.Random(f"long {name}")  # noqa: S311 - test data
    end_s = time.process_time() + SECONDS
    data = rng.choice(SEEDS[name])
    while time.process_time() < end_s:
        data = _mutated(data, rng) if rng.random() < 0.8 and len(data) < 100_000 else rng.choice(SEEDS[name])
        TARGETS[name](data)
