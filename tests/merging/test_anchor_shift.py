"""One closure more or one less: to first order, against merging again."""

import functools

import numpy as np
import pytest

from pcm_jax import InputError, lie, merge, weigh
from pcm_jax.simulation import simulate_city, simulate_sessions

QUIET = {"sigma_translation": 1e-3, "sigma_rotation": 3e-4}
OF_GROUP = {
    "SE2": (simulate_city, {"robots": 3}),
    "SE3": (
        simulate_sessions,
        {"sessions": 3, "closure_sigma_translation": 1e-3, "closure_sigma_rotation": 3e-4},
    ),
}


@functools.cache
def merged(group):
    """Three robots, hardly any noise: there first order is nearly all; closure 4 is held back."""
    simulate, options = OF_GROUP[group]
    world = simulate(seed=2, poses=40, inliers=6, aliased_groups=0, random=0, **options, **QUIET)
    evidence = weigh(world.graph)
    used = np.ones(len(world.graph.closures), bool)
    used[4] = False
    return evidence, used, merge(evidence, accepted=used)


def really(result, other):
    moved = lie.compose(lie.inverse(result.anchors), other.anchors)
    return np.asarray(lie.log(moved))


@pytest.mark.parametrize("group", ["SE2", "SE3"])
@pytest.mark.parametrize("index", [0, 4, 9])
def test_against_merging_again(group, index):
    evidence, used, result = merged(group)
    changed = used.copy()
    changed[index] = not used[index]
    again = merge(evidence, accepted=changed)
    shift, expected = result.anchor_shift(index), really(result, again)
    assert np.abs(expected[1:]).max() > 1e-6
    np.testing.assert_allclose(shift, expected, atol=2e-3 * np.abs(expected).max())
    assert not shift[0].any()


def test_what_nothing_else_holds_together():
    """Robots that one closure joins fall apart without it."""
    evidence, used, _ = merged("SE2")
    closures = evidence.graph.closures
    single = np.flatnonzero((closures.robot_a == 0) & (closures.robot_b == 1))[:1]
    result = merge(evidence, accepted=single)
    shift = result.anchor_shift(int(single[0]))
    assert np.isnan(shift[:2]).all() and not shift[2].any()
    apart = int(np.flatnonzero((closures.robot_a == 0) & (closures.robot_b == 2))[0])
    with pytest.raises(InputError, match=f"closure {apart} is between 'a' and 'c', which are not"):
        result.anchor_shift(apart)
    with pytest.raises(InputError, match=f"index: {len(used)}, expected 0"):
        result.anchor_shift(len(used))
