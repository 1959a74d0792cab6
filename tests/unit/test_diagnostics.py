"""Error norms: definitions, scaling, and numbers that are none."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from mpipic.run.diagnostics import measure, norms
from serial_helpers import grid_of, particles_of

COMM = MPI.COMM_SELF


def of(error):
    error = np.asarray(error, dtype=float)
    return norms(error, len(error), COMM)


def as_tuple(result):
    return result.l1, result.l2, result.linf


def test_norms_of_numbers_are_the_mean_the_root_mean_square_and_the_largest():
    assert as_tuple(of([3.0, -4.0, 0.0, 0.0])) == pytest.approx((7 / 4, 5 / 2, 4.0), rel=1e-15)
    error = np.random.default_rng(0).standard_normal(1000)
    wanted = np.abs(error).mean(), np.sqrt((error**2).mean()), np.abs(error).max()
    assert as_tuple(of(error)) == pytest.approx(wanted, rel=1e-13)


def test_norms_of_vectors_are_those_of_their_euclidean_lengths():
    assert as_tuple(of([[3.0, -4.0], [0.0, 0.0]])) == pytest.approx((5 / 2, 5 / np.sqrt(2), 5.0), rel=1e-15)
    error = np.random.default_rng(0).standard_normal((500, 3))
    assert as_tuple(of(error)) == pytest.approx(as_tuple(of(np.linalg.norm(error, axis=1))), rel=1e-13)


def test_a_vector_of_one_component_is_a_number():
    error = np.random.default_rng(0).standard_normal(100)
    assert as_tuple(of(error[:, None])) == pytest.approx(as_tuple(of(error)), rel=1e-15)


@pytest.mark.parametrize("scale", [1e300, 1e150, 1e-150, 1e-300, -7.0])
@pytest.mark.parametrize("shape", [(50,), (50, 3)])
def test_norms_scale_with_the_error_however_large_or_small(scale, shape):
    error = np.random.default_rng(1).uniform(-1, 1, shape)
    scaled, plain = as_tuple(of(scale * error)), as_tuple(of(error))
    assert scaled == pytest.approx([abs(scale) * x for x in plain], rel=1e-12, abs=0.0)


def test_no_error_and_no_particles_give_zero():
    assert as_tuple(of(np.zeros(5))) == as_tuple(of(np.zeros((5, 2)))) == (0.0, 0.0, 0.0)
    assert as_tuple(norms(np.empty(0), 10, COMM)) == as_tuple(norms(np.empty((0, 2)), 10, COMM)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", [0, 5, -1])
def test_one_error_that_is_not_finite_makes_all_norms_infinite(bad, where):
    number, vector, component = np.ones(9), np.ones((9, 2)), np.ones((9, 2))
    number[where], vector[where], component[where, 1] = bad, bad, bad
    for error in (number, vector, component):
        assert as_tuple(of(error)) == (np.inf, np.inf, np.inf)


def test_the_mean_is_over_the_total_given():
    """Other ranks hold the rest."""
    result = norms(np.array([3.0, 4.0]), 100, COMM)
    assert as_tuple(result) == pytest.approx((0.07, 0.5, 4.0), rel=1e-15)


def test_a_report_compares_both_fields_with_the_exact_solution_at_that_time():
    grid = grid_of((4, 4), (1.0, 1.0))
    position = np.random.default_rng(2).random((20, 2))

    def solution(x, t):
        return x[:, 0] + t, np.stack([x[:, 1], t * x[:, 0]], axis=1)

    density, velocity = solution(position, 3.0)
    particles = particles_of(grid, position, density + 0.25, velocity - [0.3, 0.4])
    report = measure(particles, {"density": density, "velocity": velocity}, 7, 3.0, 20, COMM)
    assert (report.step, report.time) == (7, 3.0)
    assert as_tuple(report.errors["density"]) == pytest.approx((0.25,) * 3, rel=1e-12)
    assert as_tuple(report.errors["velocity"]) == pytest.approx((0.5,) * 3, rel=1e-12)
    row = replace(report, shares={"null_space_fraction": None}).row()
    assert row["density_l2"] == report.errors["density"].l2
    assert row["velocity_linf"] == report.errors["velocity"].linf
    assert len(row) == 7 and row["null_space_fraction"] is None


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_rank_without_particles_reports_what_the_others_have(dim):
    particles = particles_of(grid_of((4,) * dim, (1.0,) * dim), np.empty((0, dim)))
    report = measure(particles, {"density": np.empty(0), "velocity": np.empty((0, dim))}, 7, 3.0, 20, COMM)
    assert all(as_tuple(error) == (0.0, 0.0, 0.0) for error in report.errors.values())
