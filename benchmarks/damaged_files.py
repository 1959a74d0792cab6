"""Thousands of damaged particle files: what becomes of each, and how long the slowest takes.

    ./run exec python benchmarks/damaged_files.py [--count 100000] [--seed 1] [--keep DIR]

Files and damage are those of the tests: plain HDF5 in ten ways of storing, and openPMD species in three; flipped bits,
other bytes, holes of zeros, swapped blocks, lost ends. Ends with exit code 1 if any answer is neither particles nor an
error in words, and keeps such files in DIR.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path
from time import perf_counter

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from damage_helpers import damaged, judge, write_all
from mpipic.io.apart import Apart


def main() -> int:
    """Print how many were read and refused, what else came of any, and the longest time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    outcomes, longest = Counter[str](), (0.0, "")
    with tempfile.TemporaryDirectory() as folder, Apart() as process:
        copy = Path(folder) / "copy.h5"
        for name, data in damaged(write_all(Path(folder)), asked.seed, asked.count):
            copy.write_bytes(data)
            began = perf_counter()
            outcome = judge(copy, process)
            longest = max(longest, (perf_counter() - began, name))
            outcomes[outcome if outcome in ("read", "refused") else "wrong"] += 1
            if outcome not in ("read", "refused"):
                print(f"{name}: {outcome}", flush=True)
                if asked.keep:
                    (asked.keep / f"{name.split(':')[0]}.h5").write_bytes(data)
    print(f"{dict(outcomes)}; longest {longest[0]:.2f} s, {longest[1]}")
    return 1 if outcomes["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
