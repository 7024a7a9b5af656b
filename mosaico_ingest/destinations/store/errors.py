"""Errors of a store: the translation of disk, SQLite and Arrow errors into SinkError."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Generator
from contextlib import contextmanager

import pyarrow as pa

from mosaico_ingest.errors import SinkError, SinkUnavailable, Unreachable
from mosaico_ingest.remote import AnyPath, as_ingest_error, is_transient

_HINTS = {
    errno.ENOSPC: "free some space, or choose another target.store",
    errno.EDQUOT: "free some quota, or choose another target.store",
    errno.EROFS: "choose a target.store that you can write to",
    errno.EACCES: "choose a target.store that you can write to",
    errno.EPERM: "choose a target.store that you can write to",
    errno.EEXIST: "remove the file at this path, or choose another target.store",
    errno.ENOTDIR: "remove the file at this path, or choose another target.store",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENOENT: "check whether another program changes the store, then run again",
}


class NotInStore(SinkError):  # noqa: N818 - the condition, as in `errors`
    """The store has no sequence, topic or session of this name."""


def sequence_changed(sequence: str) -> SinkError:
    """Return the error for a sequence that changed after the session started."""
    return SinkError("another run changed the sequence meanwhile", where=sequence, hint="run again")


@contextmanager
def translate_errors(where: AnyPath | str) -> Generator[None, None, None]:
    """Raise SinkError, with the location and a hint, for errors of the disk, SQLite or Arrow inside."""
    try:
        yield
    except Unreachable as err:
        raise SinkUnavailable(err.what, where=err.where, hint=err.hint) from err
    except OSError as err:
        if is_transient(err):
            cause = as_ingest_error(err, str(where))
            raise SinkUnavailable(cause.what, where=cause.where, hint=cause.hint) from err
        code = err.errno or 0
        what = os.strerror(code) if code else _first_line(err)
        raise SinkError(what, where=str(err.filename or where), hint=_HINTS.get(code)) from err
    except pa.ArrowException as err:
        raise SinkError(_first_line(err), where=str(where)) from err
    except sqlite3.OperationalError as err:
        raise _sqlite_error(err, str(where)) from err
    except sqlite3.Error as err:
        raise SinkError(f"the catalog cannot be used: {_first_line(err)}", where=str(where)) from err


def _sqlite_error(err: sqlite3.OperationalError, where: str) -> SinkError:
    text = str(err)
    if "locked" in text:
        return SinkUnavailable("the catalog is busy with another process", where=where, hint="try again")
    if "full" in text:
        return SinkError("no space left on the device", where=where, hint=_HINTS[errno.ENOSPC])
    if "readonly" in text or "unable to open" in text:
        return SinkError(f"the catalog cannot be written: {text}", where=where, hint=_HINTS[errno.EROFS])
    return SinkError(f"the catalog cannot be used: {text}", where=where)


def _first_line(err: BaseException) -> str:
    return (str(err).strip() or type(err).__name__).splitlines()[0]
