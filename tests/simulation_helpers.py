"""Whole simulations on several numbers of ranks, for tests that compare them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from helpers import TESTS, run_ranks

Result = SimpleNamespace
PROGRAM = TESTS / "parallel" / "simulate_helpers.py"


def simulated(folder: Path, cases: Mapping[str, tuple[list[str], tuple[int, ...]]]) -> Callable[[str, int], Result]:
    """Results by case and number of ranks; each number of ranks is started once, with all its cases.

    cases : name to overrides of the default scene and to the numbers of ranks.
    """
    started: set[int] = set()

    def result(name: str, ranks: int) -> Result:
        place = folder / str(ranks)
        if ranks not in started:
            started.add(ranks)
            place.mkdir()
            mine = {case: overrides for case, (overrides, wanted) in cases.items() if ranks in wanted}
            (place / "cases.json").write_text(json.dumps(mine))
            ended = run_ranks(ranks, PROGRAM, str(place / "cases.json"), str(place), timeout=280)
            assert ended.returncode == 0, ended.stdout + ended.stderr
        file = place / f"{name}.npz"
        assert file.exists(), f"the {ranks} ranks ended before this case: see the first test that failed"
        with np.load(file) as arrays:
            return SimpleNamespace(**arrays)

    return result
