"""Small and read-only file systems, also for the superuser; a test is skipped if it cannot mount one."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

MEBIBYTE = 1 << 20


@contextmanager
def small_disk(folder: Path, size_bytes: int = MEBIBYTE) -> Generator[Path, None, None]:
    """Mount a file system of this size at `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount("-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        _unmount(folder)


@contextmanager
def read_only(folder: Path) -> Generator[None, None, None]:
    """Make `folder` read-only; for the superuser with a mount, because permissions do not apply."""
    if os.geteuid():
        folder.chmod(0o500)
        try:
            yield
        finally:
            folder.chmod(0o700)
        return
    _mount("--bind", str(folder), str(folder))
    try:
        _mount("-o", "remount,bind,ro", str(folder))
        yield
    finally:
        _unmount(folder)


@contextmanager
def filled(folder: Path, *, free_bytes: int = 0) -> Generator[None, None, None]:
    """Fill a small disk until `free_bytes` are free."""
    ballast = folder / "ballast"
    ballast.write_bytes(bytes(max(shutil.disk_usage(folder).free - free_bytes, 0)))
    try:
        yield
    finally:
        ballast.unlink()


def _mount(*arguments: str) -> None:
    mount = shutil.which("mount")
    if mount is None:
        pytest.skip("the command mount does not exist")
    finished = subprocess.run([mount, *arguments], capture_output=True, check=False, text=True)  # noqa: S603 - a system command with our arguments
    if finished.returncode:
        pytest.skip(f"mount failed: {finished.stderr.strip()}")


def _unmount(folder: Path) -> None:
    """Unmount a file system, also if a killed process still has files open."""
    umount = shutil.which("umount")
    assert umount is not None
    subprocess.run([umount, "-l", str(folder)], check=True)  # noqa: S603 - fixed arguments
