"""Positions anywhere: axes are periodic, for a placement, a mapping and a plain wrap alike."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from mpipic.box import first_misplaced, misplaced, wrap
from mpipic.mapping.mapping import Mapping
from mpipic.particles.placement import Placement
from serial_helpers import grid_of, values

LENGTHS = (1.0, 0.3, 35.85686, 1e-6, 1e6)
FACES = (0.0, -0.0, 1.0, -1.0, 3.5, -1e-17, -5e-324, 5e-324, 1 - 2.0**-53, 1 + 2.0**-52, -1 + 1e-16, 2.0**40, -1e12)
"""In units of the length."""
place = st.sampled_from(FACES) | st.floats(-1e6, 1e6)


@given(st.sampled_from(LENGTHS), place)
@example(1.0, np.mod(-1e-17, 1.0))
def test_a_wrapped_position_is_in_the_box_by_whole_periods(length, at):
    (inside,) = wrap(np.array([at * length]), (length,))
    assert 0.0 <= inside < length
    off = abs(np.remainder(at * length - inside + length / 2, length) - length / 2)
    assert off <= 4 * np.spacing(max(abs(at), 1.0) * length)
    assert wrap(np.array([inside]), (length,))[0] == inside
    if 0.0 <= at * length < length:
        assert inside == at * length


@given(st.sampled_from(LENGTHS), st.lists(place, min_size=1, max_size=6))
def test_placement_and_mapping_take_the_same_positions_for_the_same(length, at):
    grid, position = grid_of((4, 3), (length, 1.0)), np.array([[x * length, 0.4] for x in at])
    placed, q = Placement(grid, position), values(len(at))
    assert np.array_equal(placed.position, grid.in_box(position))
    assert np.array_equal(Mapping(grid, placed.position).p2g(q), Mapping(grid, position).p2g(q))


@pytest.mark.parametrize("face", [1.0, -1e-17, np.mod(-1e-17, 1.0), 0.0, 7.0])
def test_the_upper_face_is_the_lower_one(face):
    grid = grid_of((5,), (1.0,))
    placed = Placement(grid, np.array([[face]]))
    assert placed.position.tolist() == [[0.0]]
    assert grid.owned(Mapping(grid, [[face]]).row_sums).tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_what_tells_no_cell_is_found_and_the_first_is_named():
    h = (0.25, 1e-3)
    far = 1e-3 * 2.0**53
    position = np.array([[0.1, 0.1], [0.1, far], [np.nan, 0.0], [-np.inf, far], [far, -far / 8]])
    found = {rule: np.flatnonzero(broken).tolist() for rule, broken in misplaced(position, h)}
    assert list(found.values()) == [[2, 3], [1]]
    assert first_misplaced("position", position[2:], h) == "position 0 = [nan, 0.0] is not finite"
    assert first_misplaced("position", position, h).startswith(f"position 1 = [0.1, {far!r}] is so far away")
    assert (
        first_misplaced("position", position[[0, 4]], h) is None
        and first_misplaced("position", np.empty((0, 2)), h) is None
    )
