"""The faults that the planter knows can all still be planted."""

from __future__ import annotations

import importlib.util
import sys

from helpers import TESTS

FILE = TESTS / "tools" / "plant_faults.py"
_spec = importlib.util.spec_from_file_location("plant_faults", FILE)
planter = importlib.util.module_from_spec(_spec)
sys.modules["plant_faults"] = planter  # where its records look for their types
_spec.loader.exec_module(planter)


def test_every_fault_has_its_text_just_once_and_its_tests_are_there() -> None:
    faults = planter.read_faults()
    assert len(faults) > 60 and len({fault.room for fault in faults}) > 10
    assert planter.misfits(faults) == []
