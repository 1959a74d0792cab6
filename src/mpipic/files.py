"""Files, read whole, and written so that they appear whole or not at all; values as JSON and CSV can hold them.

NumPy values are known by what they can do: a program that only reads a scene does not import NumPy.
"""

from __future__ import annotations

import csv
import dataclasses
import errno
import io
import json
import math
import numbers
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mpipic.errors import WriteFailed
from mpipic.interrupts import unfinished

ROOM = "free some space there, or name a folder elsewhere by --output"
ADVICE = {
    (errno.ENOSPC, errno.EDQUOT): ROOM,
    (errno.EFBIG,): "raise the limit on the size of files (ulimit -f), or write less",
    (errno.EROFS, errno.EACCES, errno.EPERM): "make it writable, or name another folder by --output",
    (errno.ENOENT, errno.ESTALE): "the folder is gone: leave it in place while it is written to",
}
"""Numbers of errors of the system to what helps."""


class Unreadable(Exception):
    """A file that cannot be read, or is no text; the message says why, as the end of a sentence about the file."""


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8, without the mark that some editors put before it.

    Raises
    ------
    Unreadable
        The file is not there, may not be read, or holds something else than UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Unreadable(f"not a text file in UTF-8 (byte {error.start})") from None
    except (OSError, ValueError) as error:
        raise Unreadable(f"cannot be read: {getattr(error, 'strerror', None) or error}") from None


def reason(error: OSError) -> str:
    """Return why the system refuses to write, and what to do, as the end of a sentence about a file."""
    why = error.strerror or str(error)
    advice = next((words for codes, words in ADVICE.items() if error.errno in codes), None)
    return f"{why}; {advice}" if advice else why


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; on success force it to disk and rename it, else remove it. Local.

    Raises
    ------
    WriteFailed
        The system refuses; an older file of this name stays as it was.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    unfinished.add(str(temporary))
    try:
        yield temporary
        sync(temporary)
        os.replace(temporary, path)
    except OSError as error:
        raise WriteFailed(f"{path} cannot be written: {reason(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        unfinished.discard(str(temporary))


def write_at(descriptor: int, data: memoryview, offset: int) -> None:
    """Write all of a contiguous buffer at a place of an open file. Local."""
    rest = data.cast("B")
    while rest:
        written = os.pwrite(descriptor, rest, offset)
        rest, offset = rest[written:], offset + written


def sync(path: Path) -> None:
    """Force the content of a file to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole, in UTF-8 with the line ends that `text` has, replacing an old one. Local."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def write_json(path: Path, value: object) -> None:
    """Write a value as strict, indented JSON: what is not finite becomes null, records become objects. Local."""
    write_text(path, to_json(value, indent=2) + "\n")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a header and rows as CSV: None is an empty cell, floats read back to the same bits. Local."""
    stream = io.StringIO()
    table = csv.writer(stream, lineterminator="\n")
    table.writerow(header)
    table.writerows([_entry(value) for value in row] for row in rows)
    write_text(path, stream.getvalue())


def to_json(value: object, indent: int | None = None) -> str:
    """Return a value as strict JSON, on one line unless indented; what is not finite becomes null."""
    return json.dumps(plain(value), indent=indent, allow_nan=False, ensure_ascii=False)


def json_object(text: str | bytes) -> dict[str, Any]:
    """Return the object that a JSON text holds; an empty one where it is no JSON, or holds something else."""
    try:
        value = json.loads(text)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def plain(value: object) -> object:
    """Turn records, NumPy values and paths into what JSON can hold; numbers that are not finite become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {item.name: plain(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def _entry(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return repr(float(value))
    return str(value)
