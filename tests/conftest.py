"""Settings of every test: examples drawn by hypothesis are the same in each run, and runs start quickly."""

import os

import pytest
from hypothesis import settings

import mpipic.run.parts  # noqa: F401  all that scenes can name, whatever a test imports

# `pytest --hypothesis-profile=default` searches anew.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# All tests are on one machine. Looking for a network takes Debian's Open MPI 0.25 s at every start of a process.
os.environ.setdefault("OMPI_MCA_pml", "ob1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """First what runs in this process: it compiles the loops once, for all; ranks started together each would."""
    items.sort(key=lambda item: not {"unit", "physics"} & set(item.path.parts))
