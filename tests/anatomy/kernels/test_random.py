"""SplitMix64 against its published sequence."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.kernels.random import uniform

# Outputs of the public-domain reference implementation by Sebastiano Vigna.
FROM_SEED = {
    0: [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F, 0xF88BB8A8724C81EC, 0x1B39896A51A8749B],
    1234567: [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ],
}


def _draw(seed: int, count: int) -> list[float]:
    state = np.array([seed], dtype=np.uint64)
    return [uniform(state) for _ in range(count)]


@pytest.mark.parametrize("seed", FROM_SEED)
def test_the_published_sequence_comes_out_as_fractions(seed: int) -> None:
    assert _draw(seed, 5) == [(word >> 11) * 2.0**-53 for word in FROM_SEED[seed]]


def test_the_largest_state_wraps_around() -> None:
    # One step before the state of seed 0.
    before = (-0x9E3779B97F4A7C15) % 2**64
    assert _draw(before, 2)[1] == _draw(0, 1)[0]


def test_the_same_state_gives_the_same_numbers() -> None:
    state = np.array([42], dtype=np.uint64)
    first = [uniform(state) for _ in range(10)]
    resumed = state.copy()
    assert first == _draw(42, 10)
    assert [uniform(state) for _ in range(10)] == [uniform(resumed) for _ in range(10)]


def test_numbers_are_uniform_in_the_half_open_unit_interval() -> None:
    numbers = np.array(_draw(7, 20_000))
    assert ((numbers >= 0.0) & (numbers < 1.0)).all()
    counts = np.histogram(numbers, bins=20, range=(0.0, 1.0))[0]
    # Chi-squared with 19 degrees of freedom; the seed is fixed.
    assert ((counts - 1000.0) ** 2 / 1000.0).sum() < 43.8
