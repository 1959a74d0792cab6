"""The paper's figures are those of dense matrices, and verdicts change sides where their rules say so."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from dense_helpers import Dense, close, run_euler
from mpipic.analysis.growth import analyse
from mpipic.figures import claims
from mpipic.figures.costs import Cost, exponent
from mpipic.figures.gradients import gradient_columns, share, sign_changes, spread_in_cells
from mpipic.figures.maps import holding, points
from mpipic.figures.plan import Plan, Survey
from mpipic.figures.waves import failing_step, misprint_errors, wave_columns
from mpipic.plots.paper import WAVE, draw_wave
from run_helpers import scene_of

CELLS, LENGTH = (16,), (1.0,)
STEPS = (0, 7, 20, 50)
SCENE = scene_of(grid={"cells": [16]}, gas={"flow": [0.0625]}, filter={"kind": "none"}, time={"dt": 0.0078125})
POSITION = (np.arange(32.0)[:, None] + 0.5) / 32
"""The lattice of the scene, in the order of the ids."""


@pytest.fixture(scope="module")
def gradients():
    return gradient_columns(SCENE, MPI.COMM_SELF)


def test_gradients_are_those_of_dense_matrices(gradients):
    dense, x = Dense(CELLS, LENGTH, POSITION), POSITION[:, 0]
    g = np.exp(-60.0 * (x - 0.5) ** 2)
    computed = dense.D[0] @ dense.S @ g
    wanted = {
        "x": x, "true": -120.0 * (x - 0.5) * g, "computed": computed, "svd": dense.projection() @ computed,
        "null_space": computed - dense.projection() @ computed, "local": dense.phi @ dense.S @ computed,
    }  # fmt: skip
    for name, values in wanted.items():
        close(gradients[name], values, 1e-10, scale=np.abs(computed).max())
    assert share(gradients["null_space"], computed) > 0.05
    assert share(gradients["svd_null_space"], computed) < 1e-10 > share(gradients["local_null_space"], computed)


def test_waves_are_those_of_dense_matrices():
    found = wave_columns(Plan(SCENE, steps=STEPS), MPI.COMM_SELF)
    density = np.sum([np.exp(-60.0 * (POSITION[:, 0] - 0.5 - k) ** 2) for k in (-1, 0, 1)], axis=0)
    flow, dt = 0.0625, 0.0078125
    for step, columns in found.items():
        for label, kind in (("unfiltered", "none"), ("svd", "svd"), ("local", "local")):
            at_rest = np.zeros((32, 1))
            wanted = run_euler(CELLS, LENGTH, POSITION, density, at_rest, (flow * dt,), (dt, dt), kind, step)
            close(columns["x"], wanted[0][:, 0], 1e-10)
            close(columns[label], wanted[1], 1e-10)
        away = columns["x"][:, None] - 0.5 - (flow + np.array([[1.0], [-1.0]]))[:, :, None] * step * dt
        exact = 0.5 * np.sum([np.exp(-60.0 * (away - k) ** 2) for k in range(-3, 4)], axis=(0, 1))[:, 0]
        close(columns["exact"], exact, 1e-10)
    assert np.abs(found[50]["svd"] - found[50]["unfiltered"]).max() > 1e-3


def test_what_measures_the_figures_measures():
    assert sign_changes(np.array([1.0, -1.0, 1.0, 1e-14, -1.0, -1.0])) == 0.75
    assert spread_in_cells(np.array([0.1, 0.4, 0.6, 0.9]), np.array([1.0, 1.0, 2.0, 4.0]), 0.5) == 0.5
    measured = [Cost("svd", m, 3.0 * m**2.5) for m in (10, 20, 40)]
    assert exponent(measured, "svd") == pytest.approx(2.5)


def test_equation_7_is_right_with_the_sign_that_is_not_printed():
    errors = misprint_errors(SCENE, 0.4)
    assert errors["corrected"] < 1e-12 < 1e-3 < errors["printed"]
    assert claims.misprint(errors).verdict == claims.CONTRADICTED
    assert claims.misprint({"printed": 1e-12}).verdict == claims.CONFIRMED


def test_a_long_run_finds_the_step_at_which_it_fails():
    fast = scene_of(grid={"cells": [16]}, filter={"kind": "none"})
    failed = failing_step(fast, 20_000)
    assert failed is not None and failed > 1000
    assert failing_step(fast, failed - 100) is None


def dense_growth(kind, flow, cfl, cells=4):
    """Growth per step of two lattice particles a cell, from the eigenvalues of one period of dense steps."""
    position, dt = (np.arange(2.0 * cells)[:, None] + 0.5) / (2 * cells), cfl / cells
    period = round(1 / (flow * cfl))  # one cell on
    one = np.eye(4 * cells)
    columns = [
        run_euler((cells,), (1.0,), position, unit[: 2 * cells], unit[2 * cells :, None], (flow * dt,), (dt, dt), kind,
                  period)
        for unit in one
    ]  # fmt: skip
    matrix = np.array([np.concatenate([density, velocity[:, 0]]) for _, density, velocity in columns]).T
    shift = np.kron(np.eye(2), np.roll(np.eye(2 * cells), 2, axis=0))
    return np.abs(np.linalg.eigvals(shift @ matrix)).max() ** (1 / period) - 1


def test_growth_of_a_map_is_that_of_dense_matrices():
    survey = Survey((0.5,), (2,), (0.2,), cells=4, error_cells=8, boxes=())
    found = points(SCENE, survey, analyse, MPI.COMM_SELF)
    kinds = {"unfiltered": "none", "svd": "svd", "local": "local", "order 2": "order"}
    assert len(found) == 12
    for point in found:
        if point.part != "random":
            assert point.growth == pytest.approx(dense_growth(kinds[point.filter], 0.5, 0.2), abs=1e-9)
            assert 0.0 < point.error < 1.0
    counted = holding(found, 10**15)
    assert sum(of for _, of in counted.values()) == 12 > sum(good for good, _ in counted.values())


# ---------------------------------------------------------------- verdicts

YES, LIMIT, NO = claims.CONFIRMED, claims.LIMITED, claims.CONTRADICTED


def grows(by):
    return SimpleNamespace(growth_per_step=by, noise_step=100.0 if by else None, blow_up_step=None)


def of_null_space(values):
    return {"null_space": np.array(values), "computed": np.ones(len(values))}


def timed(svd, local):
    powers = {"svd": svd, "exact": 1.0, "local": local}
    return [Cost(kind, m, float(m) ** p) for kind, p in powers.items() for m in (10, 20)]


PAIRED = {"x": np.array([0.1, 0.3, 0.6, 0.9]), "true": np.ones(4)}
ALTERNATING, HALF = [1.0, -1.0] * 10, [1.0, -1.0, -1.0, 1.0, -1.0, 1.0]
VERDICTS = [
    (claims.pairs({**PAIRED, "computed": np.array([1.0, 1.0, 2.0, 2.0])}, 0.5), YES),
    (claims.pairs({**PAIRED, "computed": np.array([1.0, 1.1, 2.0, 2.0])}, 0.5), NO),
    (claims.oscillation(of_null_space(ALTERNATING)), YES),
    (claims.oscillation(of_null_space(HALF)), LIMIT),
    (claims.oscillation(of_null_space([1.0, 1.0, -1.0, -1.0])), NO),
    (claims.reintroduction(of_null_space([0.1, -0.1])), YES),
    (claims.reintroduction(of_null_space([0.0, 0.0])), NO),
    (claims.removal(0.1, 1e-12, (0.2, 0.1)), YES),
    (claims.removal(0.1, 1e-12, (0.1, 0.2)), LIMIT),
    (claims.removal(0.1, 1e-3, (0.2, 0.1)), NO),
    (claims.local_filter({"computed": 0.3, "svd": 0.2, "local": 0.1}), YES),
    (claims.local_filter({"computed": 0.3, "svd": 0.1, "local": 0.2}), LIMIT),
    (claims.local_filter({"computed": 0.1, "svd": 0.2, "local": 0.3}), NO),
    (claims.interpolation(1e-3), YES),
    (claims.interpolation(1e-14), NO),
    (claims.noise_at(700, {"unfiltered": 0.2, "svd": 0.01}, 6), YES),
    (claims.noise_at(700, {"unfiltered": 0.02, "svd": 0.01}, 6), NO),
    (claims.still_stable(1000, {"unfiltered": 9.0, "svd": 0.5, "local": 0.5}, 7), YES),
    (claims.still_stable(1000, {"unfiltered": 1.0, "svd": 0.5, "local": 0.5}, 7), NO),
    (claims.still_stable(1000, {"unfiltered": float("inf"), "svd": 1.2, "local": 0.5}, 7), NO),
    (claims.local_stability(0.5, grows(0.0), None, 5000, 0), YES),
    (claims.local_stability(0.5, grows(1e-4), None, 5000, 0), LIMIT),
    (claims.local_stability(7.0, grows(1e-4), 4000, 5000, 9000), NO),
    (claims.svd_fails(3.0, grows(1e-2), 5000), YES),
    (claims.svd_fails(1.0, None, 5000), NO),
    (claims.improved_stability({"unfiltered": grows(0.05), "svd": grows(0.0)}), YES),
    (claims.improved_stability({"unfiltered": grows(0.05), "svd": grows(0.01)}), LIMIT),
    (claims.improved_stability({"unfiltered": grows(0.05), "svd": grows(0.04)}), NO),
    (claims.cost(timed(3.0, 1.0)), YES),
    (claims.cost(timed(2.0, 1.0)), LIMIT),
    (claims.cost(timed(1.2, 1.0)), NO),
    (claims.cost(timed(3.0, 2.0)), NO),
]


@pytest.mark.parametrize(("claim", "wanted"), VERDICTS)
def test_a_verdict_follows_from_the_numbers(claim, wanted):
    assert claim.verdict == wanted
    assert claim.numbers and claim.rule and all(claim.numbers.values())


def test_lines_that_blew_up_are_clipped_and_say_so(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    seen = {}
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **words: (seen.update(it=self), path.touch()))
    x, fine = np.linspace(0.0, 1.0, 9), np.full(9, 0.5)
    waves = {"svd": np.full(9, 1e30), "unfiltered": np.array([np.nan, *fine[1:]]), "local": fine}
    draw_wave(tmp_path / "wave.png", "", x, fine, waves)
    (axes,) = seen["it"].axes
    labels = [line.get_label() for line in axes.lines]
    assert labels[0] == "exact" and labels[3] == "local"
    assert "clipped" in labels[1] and "1e+30" in labels[1] and "not finite" in labels[2]
    assert axes.get_ylim() == WAVE and np.max(axes.lines[1].get_ydata()) < 3.0
