"""`narrowing`: none where errors are as stated, elsewhere by half of the orders of magnitude."""

from __future__ import annotations

import numpy as np
import pytest

from pcm_jax.consistency import chi2_gate
from pcm_jax.consistency.overstated import OVERSTATED, narrowing


@pytest.mark.parametrize("dim", [1, 3, 6])
@pytest.mark.parametrize("count", [1, 2, 9, 150])
def test_errors_as_stated_narrow_no_gate(dim, count):
    generator, gate = np.random.default_rng(count), float(chi2_gate(0.99, dim))
    narrower = [narrowing(generator.chisquare(dim, count), gate, dim) < 1.0 for _ in range(2000)]
    assert np.mean(narrower) <= 0.02  # 0.01 by design, and OVERSTATED below


@pytest.mark.parametrize("scale", [0.04, 1e-4])
def test_the_gate_follows_the_root_of_the_scale(scale):
    generator, gate = np.random.default_rng(1), float(chi2_gate(0.99, 3))
    squared = scale * generator.chisquare(3, 20_000)
    assert narrowing(squared, gate, 3) == pytest.approx(np.sqrt(scale), rel=0.05)
    assert (squared <= np.sqrt(scale) * gate).all()


def test_what_more_than_half_say_counts():
    generator, gate = np.random.default_rng(2), float(chi2_gate(0.99, 3))
    right, false = 1e-4 * generator.chisquare(3, 700), generator.uniform(0.0, gate, 300)
    beyond = np.array([np.inf, np.nan, -1.0, 2.0 * gate] * 300)
    alone = narrowing(right, gate, 3)
    assert alone < narrowing(np.concatenate([right, false, beyond]), gate, 3) < 1.5 * alone
    few = np.concatenate([right[:200], false])
    assert narrowing(few, gate, 3) > 10.0 * alone


def test_pairs_count_as_the_closures_they_are_of():
    gate, squared = float(chi2_gate(0.99, 6)), np.full(10, 0.3)
    assert narrowing(squared, gate, 6) < narrowing(squared, gate, 6, count=5)
    assert narrowing(squared, gate, 6, count=1) == 1.0


def test_a_little_too_good_is_as_stated():
    gate = float(chi2_gate(0.99, 3))
    median = float(chi2_gate(0.5, 3))
    assert narrowing(np.full(10_001, 1.1 * OVERSTATED * median), gate, 3) == 1.0
    assert narrowing(np.full(10_001, 0.9 * OVERSTATED * median), gate, 3) < 1.0
    assert narrowing(np.zeros(0), gate, 3) == 1.0
