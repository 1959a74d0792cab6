"""What each rank runs for many command lines in one start: python command_helpers.py CASES FOLDER.

CASES is a JSON file, name -> arguments of `mpipic`. What rank r says in a case goes to FOLDER/<name>.<r>.out and .err;
rank 0 writes all exit codes to FOLDER/codes.json, name -> one code a rank.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

from mpipic import cli

COMM = MPI.COMM_WORLD


@contextmanager
def said_to(stem: str) -> Iterator[None]:
    """Send both outputs of this process to files, also what compiled libraries say."""
    streams = sys.stdout, sys.stderr
    kept = [(number, os.dup(number)) for number in (1, 2)]
    for number, suffix in ((1, "out"), (2, "err")):
        file = os.open(f"{stem}.{COMM.rank}.{suffix}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
        os.close(file)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        sys.stdout, sys.stderr = streams
        for number, copy in kept:
            os.dup2(copy, number)
            os.close(copy)


def code_of(arguments: list[str]) -> object:
    """The exit code of `mpipic arguments`."""
    sys.argv = ["mpipic", *arguments]
    try:
        cli.main()
    except SystemExit as end:
        return end.code or 0
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        COMM.Abort(9)
    return 0


def main(cases: Path, folder: Path) -> None:
    """Run all cases, one after the other."""
    codes = {}
    for name, arguments in json.loads(cases.read_text()).items():
        with said_to(str(folder / name)):
            code = code_of(arguments)
        codes[name] = COMM.gather(code)
    if COMM.rank == 0:
        (folder / "codes.json").write_text(json.dumps(codes))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
