"""Errors of the linear, lumped, locally filtered scheme against the exact solution as the grid is refined.

Mapping to the nodes and back smears over a cell: second order in h. The time step is of first order, so dt goes with
h² where the second order is to show: dt = 0.2 h 16 h, CFL 0.2 on 16 cells. Time 1/4, two particles a cell and axis.
"""

import numpy as np
import pytest

from run_helpers import error_of, orders, scene_of

TIME = 0.25
FLOW = (0.05, 0.03, 0.02)


def errors(profile, dim, levels, dt_of_h=lambda h: 3.2 * h * h, layout="lattice", kind="local", flow=FLOW, **initial):
    found = []
    for n in levels:
        steps = round(TIME / dt_of_h(1 / n))
        found.append(
            error_of(
                scene_of(
                    grid={"cells": [n] * dim},
                    particles={
                        "layout": layout,
                        "per_cell": [2**dim] if layout == "random" else [2] * dim,
                        **({"jitter": 0.4} if layout == "jittered" else {}),
                    },
                    gas={"flow": list(flow[:dim])},
                    initial={"profile": profile, **initial},
                    filter={"kind": kind},
                    time={"dt": TIME / steps, "steps": steps},
                )
            )
        )
    return found


@pytest.mark.parametrize(
    "profile, flow, levels, cap",
    [
        *(("plane-wave", flow, (16, 32, 64, 128), 2e-3) for flow in (FLOW, (0.0,), (-0.7,))),
        ("gaussian", (-0.7,), (32, 64, 128, 256), 9e-4),
    ],
)
def test_second_order_in_1d_when_dt_goes_with_h_squared(profile, flow, levels, cap):
    found = errors(profile, 1, levels, flow=flow)
    assert np.mean(orders(found)) == pytest.approx(2.0, abs=0.25)
    assert found[-1] < cap


def test_first_order_in_1d_when_dt_goes_with_h():
    """CFL 0.2: refined far enough, the error is the time step's."""
    found = errors("plane-wave", 1, (64, 128, 256, 512), dt_of_h=lambda h: 0.2 * h)
    assert orders(found)[-1] == pytest.approx(1.0, abs=0.15)
    assert found[-1] < 1.2e-3


@pytest.mark.parametrize(
    "dim, profile, wave, levels, cap",
    [
        (2, "standing-wave", [1, 1], (8, 16, 32, 64), 9e-3),
        (3, "plane-wave", [1, 0, -1], (4, 8, 16, 32), 5e-2),
    ],
)
def test_second_order_in_2d_and_3d_when_dt_goes_with_h_squared(dim, profile, wave, levels, cap):
    """The coarsest level resolves little and only starts the series."""
    found = errors(profile, dim, levels, wave=wave)
    assert np.all(np.diff(found) < 0) and found[0] < 1.2
    assert orders(found)[-1] == pytest.approx(2.0, abs=0.4)
    assert found[-1] < cap


@pytest.mark.parametrize(
    "dim, layout, levels, cap",
    [
        (1, "jittered", (16, 32, 64, 128), 4e-2),
        (2, "jittered", (8, 16, 32, 64), 1.5e-2),
        (2, "random", (8, 16, 32, 64), 6e-2),
        (3, "jittered", (4, 8, 16, 32), 3.5e-2),
        (3, "random", (4, 8, 16, 32), 5e-2),
    ],
)
def test_on_disordered_particles_errors_are_bounded_and_decrease(dim, layout, levels, cap):
    found = errors("standing-wave", dim, levels, layout=layout, wave=[1] * dim)
    assert np.all(np.diff(found) < 0) and found[0] < 1.2
    assert found[-1] < cap


@pytest.mark.parametrize("dim, n", [(1, 64), (2, 32), (3, 16)])
def test_without_a_filter_a_short_run_is_as_accurate(dim, n):
    (found,) = errors("standing-wave", dim, (n,), kind="none", wave=[1] * dim)
    assert found < (0.02, 0.04, 0.15)[dim - 1]
