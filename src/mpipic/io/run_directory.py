"""The folder that a run leaves behind, and its small text files; each appears whole or not at all."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from mpipic.agreement import on_first
from mpipic.errors import OutputError
from mpipic.files import write_csv, write_json, write_text

if TYPE_CHECKING:
    from mpi4py import MPI

SCENE, SUMMARY, HISTORY = "scene.toml", "summary.json", "history.csv"
PARTICLES, ERROR_PLOT, SOLUTION_PLOT = "particles.h5", "error.png", "solution.png"
PART = ".part"
LONGEST_NAME = 150
"""Bytes of a scene's name that a folder takes over; file systems allow 255 with the time."""
RESULTS = (SUMMARY, HISTORY, PARTICLES, PARTICLES + PART)
SCENE_HEADER = "# Every value of this run, resolved; run it again with: mpipic run scene.toml\n"


class SceneText(Protocol):
    """A scene as files keep it: its name, and every value resolved as TOML."""

    @property
    def name(self) -> str:
        """Name of the scene."""
        ...

    def to_toml(self) -> str:
        """Return the scene file."""
        ...


class RunDirectory:
    """The folder of one run and its text files.

    Parameters
    ----------
    path : folder, created with its parents when missing
    comm : mpi4py communicator; rank 0 touches the disk
    overwrite : remove the files of an earlier run instead of refusing

    Raises
    ------
    OutputError
        The folder holds the results of another run, or a scene.toml that no run wrote, or cannot be written;
        `WriteFailed` where a file cannot be written later.

    Notes
    -----
    Collective. Rank 0 touches the disk; where it fails, all ranks raise the same error.
    """

    def __init__(self, path: Path | str, comm: MPI.Comm, overwrite: bool = False) -> None:
        self.path, self._comm = Path(path), comm
        self.check(self.path, comm, overwrite)
        problem = on_first(comm, lambda: _prepare(self.path))
        if problem:
            raise OutputError(problem)

    @staticmethod
    def check(path: Path, comm: MPI.Comm, overwrite: bool) -> None:
        """Raise the `OutputError` that a run into this folder would meet; changes nothing. Collective."""
        problem = on_first(comm, lambda: _refusal(path, overwrite))
        if problem:
            raise OutputError(problem)

    @staticmethod
    def default(scene_name: str, comm: MPI.Comm, parent: Path | str = "runs") -> Path:
        """Create and return runs/<scene name>-<YYYYmmdd-HHMMSS>, with -2, -3, … when taken. Collective."""
        answer = on_first(comm, lambda: _claim(Path(parent), scene_name))
        if isinstance(answer, str):
            raise OutputError(answer)
        return answer

    def write_scene(self, scene: SceneText) -> None:
        """Write scene.toml with every value resolved."""
        on_first(self._comm, lambda: write_text(self.path / SCENE, SCENE_HEADER + scene.to_toml()))

    def write_summary(self, summary: Mapping[str, object]) -> None:
        """Write summary.json as strict JSON: what is not finite becomes null; NumPy values and records are unpacked."""
        on_first(self._comm, lambda: write_json(self.path / SUMMARY, summary))

    def write_history(self, columns: Sequence[str], rows: Sequence[Mapping[str, object]]) -> None:
        """Write history.csv, one line a row; None is an empty cell, floats read back to the same bits.

        After the `columns` come any others of the rows, in the order in which they appear.
        """
        every = list(dict.fromkeys([*columns, *(key for row in rows for key in row)]))
        lines = ([row.get(column) for column in every] for row in rows)
        on_first(self._comm, lambda: write_csv(self.path / HISTORY, every, lines))


def _refusal(path: Path, overwrite: bool) -> str | None:
    """Return why a run may not use the folder; None if it may.

    A folder is an earlier run's where scene.toml says so; no other is ever cleared, nor the one that the user is in.
    """
    try:
        taken = [name for name in RESULTS if (path / name).exists()]
        scene = path / SCENE
        ours = scene.is_file() and scene.read_text("utf-8", "replace").startswith(SCENE_HEADER)
        if scene.exists() and not ours:
            taken.append(SCENE)
        if not taken:
            return None
        holds = f"output folder {path} already holds {', '.join(taken)}"
        if not ours:
            return f"{holds}, which no run of this program left there: name another folder by --output"
        if not overwrite:
            return f"{holds}: name another folder by --output, or replace them by --overwrite"
        if path.resolve() == Path.cwd():
            return f"{holds}, and is the working folder, which --overwrite does not clear: name another by --output"
    except OSError as error:
        return f"output folder {path} cannot be used: {error.strerror or error}"
    return None


def _prepare(path: Path) -> str | None:
    """Make the folder and clear it of what an earlier run left; returns what is wrong."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        for name in (*RESULTS, SCENE, ERROR_PLOT, SOLUTION_PLOT):
            (path / name).unlink(missing_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            return f"output folder {path} cannot be written: permission denied"
    except OSError as error:
        return f"output folder {path} cannot be used: {error.strerror or error}"
    return None


def _claim(parent: Path, scene_name: str) -> Path | str:
    """Create a folder that did not exist before: two runs started in the same second get two folders."""
    short = scene_name.encode()[:LONGEST_NAME].decode(errors="ignore")
    name = re.sub(r"[^\w.-]+", "-", short).strip("-.") or "run"
    stem = f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    count = 1
    while True:
        path = parent / (stem if count == 1 else f"{stem}-{count}")
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            if not path.is_dir():
                return f"output folder {parent} cannot be used: {path} is not a folder"
            count += 1
        except OSError as error:
            return f"output folder {path} cannot be created: {error.strerror or error}"
