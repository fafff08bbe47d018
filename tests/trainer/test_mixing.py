"""Several streams of samples mixed into one."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trainer.data import TrainingBatch
from trainer.dataset_windows import MixedSampler


class Numbered:
    """Samples that carry nothing but their index and whose they are."""

    def __init__(self, name: int) -> None:
        self.name = name

    def batch(self, first_index: int, count: int) -> TrainingBatch:
        numbers = np.arange(first_index, first_index + count)
        return TrainingBatch(*[np.column_stack([np.full(count, self.name), numbers])] * len(TrainingBatch._fields))


def drawn_by(shares: list[float], first_index: int, count: int) -> list[tuple[int, int]]:
    """Whose and which sample each of a batch is."""
    mixed = MixedSampler([Numbered(name) for name in range(len(shares))], shares)
    return [(int(name), int(number)) for name, number in mixed.batch(first_index, count).K]


def test_a_share_of_less_than_a_sample_comes_in_some_batches() -> None:
    counts = [sum(name == 0 for name, _ in drawn_by([0.02, 0.98], 24 * b, 24)) for b in range(50)]
    assert sum(counts) == 24  # 2 % of 1,200
    assert set(counts) == {0, 1}


@given(st.lists(st.integers(1, 60), min_size=2, max_size=4), st.integers(0, 10**7), st.integers(1, 64))
def test_every_stretch_of_the_stream_keeps_the_shares_and_repeats_nothing_however_it_is_cut(
    parts: list[int], first: int, count: int
) -> None:
    shares = [part / sum(parts) for part in parts]
    whole = drawn_by(shares, first, 2 * count)
    assert len(set(whole)) == 2 * count
    assert sorted(drawn_by(shares, first, count) + drawn_by(shares, first + count, count)) == sorted(whole)
    for name, share in enumerate(shares):
        assert abs(sum(one == name for one, _ in whole) - share * 2 * count) < len(shares)
