"""A study keeps a record of every run, line by line, so that none is run twice."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypedDict, cast

from mpipic.errors import OutputError, WriteFailed
from mpipic.files import json_object, plain, reason, to_json, write_at
from mpipic.study.points import Point

COMPLETED, UNSTABLE, TIMEOUT, CRASHED = "completed", "unstable", "timeout", "crashed"
NOT_CONVERGED, REFUSED = "not converged", "refused"
FAILED = (TIMEOUT, CRASHED, NOT_CONVERGED, REFUSED)
POINTS = "points.jsonl"

Errors = Mapping[str, Mapping[str, float | None]]
"""Name of a field to norms of its error, by name."""


class Machine(TypedDict):
    """Facts of a machine; cores are whole ones, threads those that a process may use."""

    processor: str
    cores: int
    threads: int
    memory_bytes: int
    system: str
    host: str


class Seconds(TypedDict):
    """Where the time of a run went."""

    total: float
    setup: float
    step: float
    phases: Mapping[str, float]


class Told(TypedDict, total=False):
    """A run's own summary tells this, and a study keeps it; None where the run left no summary."""

    steps: int | None
    time: float | None
    ranks: int | None
    particles: int | None
    nodes: int | None
    seconds: Seconds | None
    particle_steps_per_second: float | None
    blow_up: Mapping[str, object] | None
    versions: Mapping[str, str] | None


class Record(Told):
    """A run: of which point, which of its repeats, how it ended, and what its summary tells."""

    id: str
    repeat: int
    status: str
    message: str
    errors: Errors | None
    wall_seconds: float
    peak_memory: int
    timeout: float
    finished: str
    machine: Machine


class Journal:
    """Keeps every run in DIR/points.jsonl, a line each, forced to disk as it ends; the later line for a run counts.

    Raises
    ------
    OutputError
        Another study is writing there, or the folder cannot be written.
    """

    def __init__(self, folder: Path, fresh: bool = False) -> None:
        try:
            self._file = (folder / POINTS).open("a+b")
        except OSError as error:
            raise OutputError(f"output folder {folder} cannot be used: {error.strerror or error}") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise OutputError(f"another study is writing to {folder}: wait for it, or name another --output") from None
        except OSError:
            pass  # a file system without locks
        if fresh:
            self._file.truncate(0)
        self._runs: dict[str, dict[int, Record]] = {}
        self._file.seek(0)
        whole = 0
        for line in self._file:
            whole += len(line) if line.endswith(b"\n") else 0
            record = _parse(line)
            if record is not None:
                self._runs.setdefault(record["id"], {})[record["repeat"]] = record
        self._file.truncate(whole)  # what a power failure left of a last line

    def of(self, point: Point) -> list[Record]:
        """Return the runs of a point so far, by number of repeat, of any study in this folder."""
        return [record for _, record in sorted(self._runs.get(point.id, {}).items())]

    def add(self, record: Record) -> None:
        """Keep a run."""
        before = self._file.seek(0, os.SEEK_END)
        try:
            write_at(self._file.fileno(), memoryview((to_json(record) + "\n").encode()), before)
            os.fsync(self._file.fileno())
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), before)
            raise WriteFailed(f"{self._file.name}: a run cannot be recorded: {reason(error)}") from error
        self._runs.setdefault(record["id"], {})[record["repeat"]] = cast(Record, plain(record))

    def forget(self, points: Sequence[Point], timeout: float, statuses: Sequence[str] = ()) -> None:
        """Let runs of these points be done again that ended so, or that were given less time than `timeout`."""
        for point in points:
            for record in self.of(point):
                late = record["status"] == TIMEOUT and record["timeout"] < timeout
                if late or record["status"] in statuses:
                    del self._runs[point.id][record["repeat"]]

    def close(self) -> None:
        """Let others write."""
        self._file.close()


def _parse(line: bytes) -> Record | None:
    record = json_object(line)
    return cast(Record, record) if {"id", "status", "repeat"} <= set(record) else None
