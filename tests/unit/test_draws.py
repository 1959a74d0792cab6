"""Claims about numbers drawn by id: they depend on the id alone, and are as random or as even as they say."""

from __future__ import annotations

import numpy as np
import pytest

from mpipic.draws import golden_turns, noise, uniform

IDS = np.arange(10_000)


@pytest.mark.parametrize("start", [0, 1, 1 << 40])
def test_uniform_numbers_are_numpys_philox_at_the_counter_of_the_id(start: int) -> None:
    ids = np.arange(start, start + 3)
    for row, number in zip(uniform(7, ids, 3), ids, strict=True):
        stream = np.random.Philox(key=7, counter=int(number))
        assert np.array_equal(row, np.random.Generator(stream).random(4)[:3])
    with pytest.raises(ValueError, match="consecutive"):
        uniform(7, ids[[0, 2]], 3)
    assert uniform(7, ids[:0], 2).shape == (0, 2)


def test_noise_is_splitmix64() -> None:
    """The first outputs of the published generator with seed 0."""
    published = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert np.array_equal(noise(np.arange(3)), [(z >> 11) * 2.0**-52 - 1.0 for z in published])


def test_noise_is_white_and_depends_on_the_id_alone() -> None:
    q = noise(IDS)
    assert q.min() >= -1.0 and q.max() < 1.0 and abs(q.mean()) < 0.02 and abs(q.var() - 1 / 3) < 0.01
    for lag in (1, 2, 64):
        assert abs(np.corrcoef(q[:-lag], q[lag:])[0, 1]) < 0.03
    order = np.random.default_rng(1).permutation(len(IDS))
    assert np.array_equal(noise(IDS[order]), q[order])


def test_golden_turns_are_even_over_any_run_of_ids() -> None:
    for start in (0, 12_345, 1 << 50):
        turns = np.sort(golden_turns(np.arange(start, start + 1000))) * 2.0**-64
        gaps = np.diff(turns)
        assert len(np.unique(turns)) == 1000 and gaps.min() > 0.3 / 1000 and gaps.max() < 3.0 / 1000
