"""Plant known faults in a copy of the package, one at a time, and say which test catches each.

    python tests/tools/plant_faults.py [--quick] [--count] [--only NAME ...] [--room ROOM ...] [--list]

The faults are in `faults.toml`. Each is applied to a copy of the tree that has a folder of its own for compiled loops.
The tests most likely to catch it run first; if all pass, the whole suite does, up to the first failure. Exit code 1 if
a fault is missed, 2 if one no longer fits the source or the tests fail without any.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FAULTS = Path(__file__).with_name("faults.toml")
OWN_TEST = "unit/test_planted_faults.py"
"""It holds faults to the source, so that it would see any that is planted."""
PACKAGE = Path("src/mpipic")
FAILED = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", re.MULTILINE)
NO_TESTS = (4, 5)
"""Exit codes of pytest for tests that are not there."""


@dataclass(frozen=True)
class Fault:
    """One slip of the pen: `old` occurs once in `file` (below the package) and becomes `new`."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]

    @property
    def room(self) -> str:
        return self.file.split("/")[0].removesuffix(".py")

    @property
    def selectors(self) -> list[str]:
        return [f"tests/{test}" for test in self.tests]


@dataclass(frozen=True)
class Result:
    """What pytest made of a tree: the tests that failed, or why there is no answer."""

    failed: tuple[str, ...]
    seconds: float
    trouble: str = ""


@dataclass(frozen=True)
class Row:
    """A line of the table."""

    fault: Fault
    caught: str
    likely: bool
    red: int
    seconds: float


def read_faults(path: Path = FAULTS) -> list[Fault]:
    """Return all faults, in the order of the file."""
    entries = tomllib.loads(path.read_text("utf-8"))["fault"]
    return [Fault(**{**entry, "tests": tuple(entry["tests"])}) for entry in entries]


def misfits(faults: Sequence[Fault], root: Path = ROOT) -> list[str]:
    """Return one sentence for every fault that cannot be planted: text gone or ambiguous, name twice, tests gone."""
    names = [fault.name for fault in faults]
    found = [f"{name}: there are {names.count(name)} faults of this name" for name in {*names} if names.count(name) > 1]
    for fault in faults:
        path = root / PACKAGE / fault.file
        count = path.read_text("utf-8").count(fault.old) if path.exists() else 0
        if count != 1:
            found.append(f"{fault.name}: {fault.file} has its text {count} times, not once: {fault.old!r}")
        if fault.old == fault.new:
            found.append(f"{fault.name}: changes nothing")
        gone = [test for test in fault.selectors if not (root / test.split("::")[0]).exists()]
        found += [f"{fault.name}: there is no {test}" for test in gone]
    return found


def copy_tree(folder: Path) -> Path:
    """Copy what the repository tracks, and new files that it does not ignore, into an empty folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, check=True,
        capture_output=True, text=True,
    ).stdout  # fmt: skip
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target)
    return folder


@contextmanager
def planted(fault: Fault, tree: Path) -> Iterator[None]:
    """Have the fault in the tree for a while."""
    path = tree / PACKAGE / fault.file
    whole = path.read_text("utf-8")
    path.write_text(whole.replace(fault.old, fault.new), "utf-8")
    try:
        yield
    finally:
        # with its old date: neither Python nor Numba may take what they compiled of the fault for this
        path.write_text(whole, "utf-8")
        shutil.copystat(ROOT / PACKAGE / fault.file, path)


class Tests:
    """Runs tests of a tree, whose compiled loops are kept in a folder beside it."""

    def __init__(self, tree: Path, cache: Path) -> None:
        self.tree = tree
        kept = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        self.variables = {**kept, "PYTHONPATH": str(tree / "src"), "XDG_CACHE_HOME": str(cache)}
        self._imports_the_copy()

    def _imports_the_copy(self) -> None:
        words = [sys.executable, "-c", "import mpipic; print(mpipic.__file__)"]
        out = subprocess.run(words, env=self.variables, cwd=self.tree, capture_output=True, text=True, check=True)
        if not Path(out.stdout.strip()).is_relative_to(self.tree):
            raise SystemExit(f"the tests would import {out.stdout.strip()}, not the copy in {self.tree}")

    def run(self, selectors: Sequence[str], most: int, seconds: float) -> Result:
        """Run these tests up to so many failures; a run that takes longer than `seconds` has no answer."""
        words = [
            sys.executable, "-m", "pytest", "-q", "-rfE", "--tb=no", "--no-header", "-p", "no:cacheprovider",
            f"--maxfail={most}", f"--ignore=tests/{OWN_TEST}", *selectors,
        ]  # fmt: skip
        began = time.monotonic()
        process = subprocess.Popen(
            words, env=self.variables, cwd=self.tree, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            out, _ = process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGTERM)  # mpiexec too, which takes its ranks along
            process.communicate()
            return Result((), time.monotonic() - began, f"no answer in {seconds:g} s")
        failed, spent = tuple(dict.fromkeys(FAILED.findall(out))), time.monotonic() - began
        if failed or process.returncode == 0:
            return Result(failed, spent)
        why = "these tests are not there" if process.returncode in NO_TESTS else f"pytest ended {process.returncode}"
        return Result((), spent, f"{why}: {' '.join(selectors)}\n{out[-2000:]}")


def judge(fault: Fault, tests: Tests, options: argparse.Namespace) -> Row:
    """Plant one fault and look which test sees it."""
    with planted(fault, tests.tree):
        result = tests.run(fault.selectors, 1000 if options.count else 1, options.likely_seconds)
        likely, spent = bool(result.failed), result.seconds
        if not result.failed and not result.trouble and not options.quick:
            result = tests.run([], 1, options.suite_seconds)
            spent += result.seconds
    caught = result.failed[0] if result.failed else result.trouble or "MISSED"
    return Row(fault, caught, likely, len(result.failed), spent)


def show(row: Row, count: bool) -> str:
    """Return a line of the table."""
    red = f"{row.red:4d} red" if count and row.likely else "        "
    caught = row.caught.splitlines()[0]
    return f"{row.fault.name:34s} {row.seconds:6.0f} s {red}  {'' if row.likely else '! '}{caught}"


def read_options() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these faults")
    parser.add_argument("--room", nargs="+", metavar="ROOM", help="the faults of these rooms, such as kernels")
    parser.add_argument("--quick", action="store_true", help="only the tests most likely to catch each")
    parser.add_argument("--count", action="store_true", help="run the likely tests to their end and count the red ones")
    parser.add_argument("--list", action="store_true", help="print the faults and check that they fit the source")
    parser.add_argument("--no-baseline", action="store_true", help="do not first run the likely tests without a fault")
    parser.add_argument("--folder", type=Path, help="keep the copy and its compiled loops here, for the next time")
    parser.add_argument("--likely-seconds", type=float, default=600.0, help="limit of the likely tests of a fault")
    parser.add_argument("--suite-seconds", type=float, default=3600.0, help="limit of the whole suite")
    return parser.parse_args()


def chosen(faults: Sequence[Fault], options: argparse.Namespace) -> list[Fault]:
    """Return the faults asked for."""
    names, rooms = {*(options.only or ())}, {*(options.room or ())}
    unknown = (names - {fault.name for fault in faults}) | (rooms - {fault.room for fault in faults})
    if unknown:
        raise SystemExit(f"there is no fault or room {', '.join(sorted(unknown))}")
    return [
        fault for fault in faults
        if (not names or fault.name in names) and (not rooms or fault.room in rooms)
    ]  # fmt: skip


def plant_all(faults: Sequence[Fault], folder: Path, options: argparse.Namespace) -> int:
    """Judge one fault after another, printing as they come; return the exit code."""
    tree = folder / "tree"
    shutil.rmtree(tree, ignore_errors=True)
    tests = Tests(copy_tree(tree), folder / "cache")
    if not options.no_baseline:
        selectors = sorted({selector for fault in faults for selector in fault.selectors})
        result = tests.run(selectors, 1000, options.suite_seconds)
        if result.failed or result.trouble:
            print("without a fault:", *(result.failed or [result.trouble]), sep="\n  ")
            return 2
        print(f"without a fault the likely tests pass, {result.seconds:.0f} s", flush=True)
    rows = []
    for fault in faults:
        rows.append(judge(fault, tests, options))
        print(show(rows[-1], options.count), flush=True)
    missed = [row.fault.name for row in rows if not row.red]
    print(f"{len(rows) - len(missed)} of {len(rows)} faults caught" + "".join(f"\n  missed: {m}" for m in missed))
    return int(bool(missed))


def main() -> int:
    """Do what the command line asks for."""
    options = read_options()
    faults = read_faults()
    problems = misfits(faults)
    faults = chosen(faults, options)
    if options.list:
        for fault in faults:
            print(f"{fault.room:9s} {fault.name:34s} {' '.join(fault.tests)}")
        print(f"{len(faults)} faults")
    if problems:
        print(*problems, sep="\n", file=sys.stderr)
        return 2
    if options.list:
        return 0
    if options.folder:
        options.folder.mkdir(parents=True, exist_ok=True)
        return plant_all(faults, options.folder.resolve(), options)
    with tempfile.TemporaryDirectory(prefix="mpipic-faults-") as folder:
        return plant_all(faults, Path(folder), options)


if __name__ == "__main__":
    sys.exit(main())
