"""Disks that are small or may only be read, for the superuser too; tests are skipped where none can be had."""

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
    """Make `folder` a file system of this size."""
    folder.mkdir(parents=True, exist_ok=True)
    _mount("-t", "tmpfs", "-o", f"size={size_bytes}", "tmpfs", str(folder))
    try:
        yield folder
    finally:
        _unmount(folder)


@contextmanager
def read_only(folder: Path) -> Generator[None, None, None]:
    """Let nothing be written below `folder`; permissions do not stop the superuser, a mount does."""
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
def filled(folder: Path, *, left_bytes: int = 0) -> Generator[None, None, None]:
    """Take the space of a small disk, but for so many bytes."""
    ballast = folder / "ballast"
    ballast.write_bytes(bytes(max(shutil.disk_usage(folder).free - left_bytes, 0)))
    try:
        yield
    finally:
        ballast.unlink()


def _mount(*arguments: str) -> None:
    mount = shutil.which("mount")
    if mount is None:
        pytest.skip("there is no mount command")
    done = subprocess.run([mount, *arguments], capture_output=True, check=False, text=True)  # noqa: S603 - a system command, our arguments
    if done.returncode:
        pytest.skip(f"nothing may be mounted here: {done.stderr.strip()}")


def _unmount(folder: Path) -> None:
    """Unmount even where a process that was killed still has something open."""
    umount = shutil.which("umount")
    assert umount is not None
    subprocess.run([umount, "-l", str(folder)], check=True)  # noqa: S603 - as above
