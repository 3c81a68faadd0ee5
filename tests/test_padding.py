"""Padded sizes are few, large enough, and not much larger."""

import numpy as np
import pytest

from pcm_jax.arrays import bucket, pad_leading


def test_buckets_are_few_and_sufficient():
    sizes = [bucket(size) for size in range(1, 1025)]
    assert all(padded >= size for size, padded in enumerate(sizes, start=1))
    assert sorted(set(sizes)) == [16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024]
    assert all(padded < 1.5 * size + 1 for size, padded in enumerate(sizes, start=1) if size > 16)


def test_coarse_buckets():
    sizes = {bucket(size, smallest=64, fine_above=256) for size in range(1, 1025)}
    assert sorted(sizes) == [64, 128, 256, 384, 512, 768, 1024]


def test_padding_repeats_the_last_row():
    rows = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(pad_leading(rows, 4)[2:], [[3.0, 4.0], [3.0, 4.0]])
    np.testing.assert_array_equal(pad_leading(rows[:0], 2), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="smaller than the 2 rows"):
        pad_leading(rows, 1)
