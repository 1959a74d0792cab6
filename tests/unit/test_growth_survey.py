"""The survey of growth in benchmarks/: its dense matrices are the package's steps, on any basis and dimension."""

import argparse
import importlib.util

import numpy as np
import pytest

from helpers import ROOT

_spec = importlib.util.spec_from_file_location("growth_survey", ROOT / "benchmarks" / "growth.py")
survey = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(survey)

TIGHT = ["mapping.tolerance=1e-13"]
MOVES = {1: (0.4, 2, (1,)), 2: (0.5, 2, (1, 3)), 3: (0.4, 2, (1, 1, 2))}


def chosen(scheme, dim, cells, changes=()):
    solver = [] if scheme == "paper" else TIGHT
    return argparse.Namespace(scheme=scheme, dim=dim, cells=cells, set=[*solver, *changes])


@pytest.mark.parametrize("scheme", survey.SCHEMES)
@pytest.mark.parametrize("dim, cells, layout", [(1, 9, "random"), (2, 5, "jittered"), (3, 4, "random")])
def test_the_survey_takes_the_steps_of_the_package(scheme, dim, cells, layout):
    setting = MOVES[dim]
    made = survey.scene_of(chosen(scheme, dim, cells), layout, 2, 3, setting)
    growth, differences = survey.examine(made, setting, held=True)
    assert differences[0] < 1e-11, "M q"
    assert len(differences) == 1 or differences[1] < 1e-9, "growth"
    assert growth > -1e-9


def test_the_survey_takes_the_keys_of_a_scene():
    keys = ["mapping.penalty=0.3", "mapping.penalty_order=2", "mapping.gradient_order=4", "damping.order=3",
            "damping.strength=2.5", "damping.null_space=0.5"]  # fmt: skip
    made = survey.scene_of(chosen("recommended", 1, 8, keys), "random", 2, 0, MOVES[1])
    _, differences = survey.examine(made, MOVES[1], held=True)
    assert max(differences) < 1e-11


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_every_flow_of_the_survey_recurs_when_it_says(dim):
    for setting in survey.SETTINGS[dim]:
        made = survey.scene_of(chosen("recommended", dim, 4), "random", 1, 0, setting)
        assert survey.find(made, 100).steps == setting[1]
        assert all(setting[2]) or setting[1] == 1, "all axes move"
    speeds = [np.linalg.norm(cells) / period / cfl for cfl, period, cells in survey.SETTINGS[dim]]
    assert min(speeds) == 0.0 and max(speeds) > 1.9


def test_the_largest_eigenvalue_gives_the_growth():
    assert survey.growth_of(np.diag([1.21, -0.5, 1.0]), 2) == pytest.approx(0.1, rel=1e-12)
