"""Run into true full disks: file systems in memory of several sizes, on 1 to 3 ranks; each run must end in order.

    python benchmarks/full_disk.py [FOLDER]

Needs the right to mount (root). Prints, for each size and number of ranks, the exit code, the seconds, the snapshots
that stayed readable and whether a summary had room; ends with 1 if any run hung, crashed or left an unreadable file.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import h5py

SIZES = (8, 16, 24, 32, 64, 96, 128, 200, 300)
LONGEST = 60.0
SCENE = ["--set", "output.every=1", "--set", "time.steps=300", "--set", "output.report_at=[0, 5]"]


def run(folder: Path, ranks: int) -> tuple[int | str, str]:
    """Run until the disk is full; returns the exit code, or what went wrong, and what was said to standard error."""
    launcher = ["mpiexec", "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
    command = [*launcher, sys.executable, "-m", "mpipic", "run", "--quiet", "--output", str(folder / "out"), *SCENE]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return "hangs", ""
    return ended.returncode, ended.stderr


def readable(path: Path) -> int:
    """Count the snapshots of a file, each read whole."""
    if not path.exists():
        return 0
    with h5py.File(path) as file:
        return sum(len(file[f"data/{step}/particles/gas/density"][:]) > 0 for step in file["data"])


def main(parent: str | None) -> int:
    """Fill every disk; returns the exit code."""
    bad = 0
    for size in SIZES:
        for ranks in (1, 2, 3):
            folder = Path(tempfile.mkdtemp(dir=parent))
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(folder)], check=True)
            try:
                began = time.monotonic()
                code, said = run(folder, ranks)
                spent, count = time.monotonic() - began, readable(folder / "out" / "particles.h5")
                summary = "summary" if (folder / "out" / "summary.json").exists() else "no room for a summary"
            finally:
                subprocess.run(["umount", str(folder)], check=True)
                folder.rmdir()
            good = code == 1 and "No space left on device" in said and "Traceback" not in said
            bad += not good
            print(f"{size:4d} kB, {ranks} ranks: {code}, {spent:.1f} s, {count} snapshots, {summary}", flush=True)
            if not good:
                print(said)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1] if len(sys.argv) > 1 else None))
