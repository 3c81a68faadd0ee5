"""Odometry's errors by the length of loops: sums and covariances, drift whose law is known."""

import dataclasses

import jaxlie
import numpy as np
import pytest

from pcm_jax import PoseGraph, lie
from pcm_jax.integrity.calibration import closing_edges
from pcm_jax.integrity.loop_lengths import Growth, LengthFactor, _chain, _odometry, growth
from pcm_jax.integrity.loop_lengths import _all_loops as all_loops
from pcm_jax.integrity.variance_components import Part
from pcm_jax.mapping import optimize
from pcm_jax.simulation import simulate_city, simulate_sessions

SIGMA = np.array([0.02, 0.02, 0.002])
ONES = np.ones(4)


def part_of(graph):
    closing = closing_edges(graph)
    return Part(optimize(graph).graph, closing, closing & False)


def rounds(errors, laps=24, sides=60):
    """Laps of a circle, with a closure to the lap before and to the first one every fifth pose."""
    count = laps * sides
    step = np.array([1.0, 0.0, 2.0 * np.pi / sides])
    truth = [lie.identity(jaxlie.SE2)]
    for _ in range(sides - 1):
        truth.append(lie.compose(truth[-1], lie.as_numpy(lie.exp(jaxlie.SE2, step))))
    truth = lie.take(lie.stack(truth), np.arange(count) % sides)
    later = np.arange(sides, count, 5)
    tail = np.concatenate([np.arange(count - 1), later - sides, later % sides])
    head = np.concatenate([np.arange(1, count), later, later])
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    noise = SIGMA * np.concatenate(
        [errors(count - 1), np.random.default_rng(9).normal(size=(2 * len(later), 3))]
    )
    return PoseGraph.from_arrays(
        poses=truth,
        tail=tail,
        head=head,
        measurement=lie.compose(exact, lie.as_numpy(lie.exp(jaxlie.SE2, noise))),
        covariance=np.tile(np.diag(SIGMA**2), (len(tail), 1, 1)),
    )


def white(count):
    return np.random.default_rng(3).normal(size=(count, 3))


def biased(count):
    """White noise, and a heading that is off by the same at every step."""
    return white(count) + np.array([0.0, 0.0, 0.3])


def taken_back(count):
    """White noise, and an error three times as large that the next step takes back."""
    return white(count) + 3.0 * np.diff(
        np.random.default_rng(4).normal(size=(count + 1, 3)), axis=0
    )


def test_independent_errors_have_one_factor():
    found = growth([part_of(rounds(white))], ONES)
    assert [one.poses for one in found.lengths] == [10, 100, 1000]
    assert found.p_value > 0.05
    assert not found.uneven
    assert found.deviation == 0.0
    for one in found.lengths:
        assert one.interval[0] < 1.0 < one.interval[1]


def test_a_bias_grows_faster():
    """A thousand steps of 0.3 sigma add up to 300 sigma, where noise has 32: ten times more."""
    found = growth([part_of(rounds(biased))], ONES)
    short, long = found.lengths[0], found.lengths[-1]
    assert found.uneven
    stated = found.variance**0.5
    assert 0.8 < stated * short.times < 1.5
    assert stated * long.interval[0] > 1.5
    assert stated * long.times > 3.0
    assert found.deviation > 0.3
    squares = np.mean([one.times**2 for one in found.lengths])
    assert squares == pytest.approx(1.0)
    assert found.words.startswith("odometry's errors grow faster with the way")
    assert "1,000 poses and more" in found.words


def test_errors_that_take_each_other_back_grow_more_slowly():
    """A sum of n such steps has the variance of n + 18 steps, not of 19 n."""
    found = growth([part_of(rounds(taken_back))], ONES)
    assert found.uneven
    short, long = (found.variance**0.5 * one.times for one in (found.lengths[0], found.lengths[-1]))
    assert short > 1.4
    assert 0.7 < long < 1.5
    assert found.words.startswith("odometry's errors grow more slowly with the way")


@pytest.mark.parametrize(("simulate", "poses"), [(simulate_city, 120), (simulate_sessions, 300)])
def test_sums_around_loops_are_the_errors_and_their_covariance(simulate, poses):
    """The operator that sums errors around loops, as a matrix: P and Z are what it makes of Σ."""
    one = simulate(seed=0, poses=poses, inliers=4, random=2, aliased_groups=0).graph.maps[0]
    part = part_of(one)
    chain = _chain(part, ONES)
    loops = all_loops(chain)
    assert loops.paired.any()
    assert not loops.paired.all()
    d, count = one.tangent_dim, len(chain.start)
    unit = np.eye(count * d).reshape(count, d, count * d)
    operator = chain.around(unit, loops).reshape(len(loops.length), d, count, d)
    stated = chain.covariance * chain.step[:, None, None]
    of_steps = np.einsum("liej,ejk,lmek->lim", operator, stated, operator, optimize=True)
    np.testing.assert_allclose(of_steps, _odometry(chain, loops), rtol=1e-9, atol=1e-15)
    steps = np.abs(operator).max(axis=(1, 3))[:, chain.step].round().sum(axis=1)
    np.testing.assert_array_equal(steps, loops.length)


def test_poses_play_no_part_in_what_a_loop_misses():
    """Moved poses move residuals, and what is left around a loop stays, to first order."""
    part = part_of(simulate_city(seed=5, poses=60).graph.maps[0])
    chain = _chain(part, ONES)
    loops = all_loops(chain)
    other = _chain(part, np.array([1.0, 1.0, 100.0, 100.0]))
    ours, theirs = (each.around(each.residual[..., None], loops) for each in (chain, other))
    moved = np.abs(chain.residual - other.residual).max()
    assert moved > 0.01
    np.testing.assert_allclose(ours, theirs, atol=0.1 * moved)


def test_nothing_is_said_of_no_loops():
    part = part_of(rounds(white, laps=2))
    chain = part.graph.with_edges(~part.closing)
    none = Part(chain, np.zeros(chain.num_edges, bool), np.zeros(chain.num_edges, bool))
    assert growth([none], ONES) == Growth()
    assert not Growth().uneven
    assert Growth().as_dict() == {"p": 1.0, "loops": []}


def test_words_say_which_way():
    def words(*times):
        lengths = (
            LengthFactor(10**k, 9, each, (0.5 * each, 1.5 * each)) for k, each in enumerate(times)
        )
        return Growth(tuple(lengths), 0.005).words

    assert words(1.0, 2.0, 4.0).startswith("odometry's errors grow faster with the way")
    assert words(1.0, 0.2).startswith("odometry's errors grow more slowly with the way")
    assert words(1.0, 5.0, 1.0).startswith("odometry's errors do not grow with the way as")
    assert words(1.0, 1.5).startswith("odometry's errors do not grow with the way as")
    told = "1 times (0.5 to 1.5) as large as these factors say in loops of 1 to 9 poses"
    assert f"{told}, 2 times (1 to 3) in loops of 10 poses and more" in words(1.0, 2.0)


def test_plain_data():
    one = LengthFactor(10, 7, 1.5, (1.0, 2.0))
    told = dataclasses.replace(Growth(), lengths=(one,), p_value=0.5).as_dict()
    assert told == {
        "p": 0.5,
        "loops": [{"poses": 10, "loops": 7, "times": 1.5, "interval": [1.0, 2.0]}],
    }
