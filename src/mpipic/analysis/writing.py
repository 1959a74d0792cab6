"""Where verbs write: looked at before anything is computed, which may take hours."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from mpipic.agreement import on_first
from mpipic.errors import OutputError

if TYPE_CHECKING:
    from mpi4py import MPI


def make_folder(folder: Path, comm: MPI.Comm) -> None:
    """Make a folder, or raise OutputError, on all ranks, where it cannot be written. Collective."""

    def make() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        _check(folder)

    on_first(comm, make)


def check_file(path: Path | None, comm: MPI.Comm) -> None:
    """Raise OutputError, on all ranks, where a file, if any, could not be written. Collective."""

    def check() -> None:
        if path is not None and path.is_dir():
            raise OutputError(f"{path} is a folder: name a file in it by --output")
        if path is not None and not path.parent.is_dir():
            raise OutputError(f"{path} cannot be written: there is no folder {path.parent}")
        if path is not None:
            _check(path.parent)

    on_first(comm, check)


def _check(folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"folder {folder} cannot be written: permission denied")
