"""Robust merging: kernels on paper, tiny worlds whose answer is known, starts good and bad."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import chi2, multivariate_normal

from pcm_jax import lie
from pcm_jax.cli._arguments import parser
from pcm_jax.consistency import chi2_gate, odometry_edges
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.merging import ROBUST_METHODS
from pcm_jax.merging.robust import solve as robust
from pcm_jax.merging.robust.methods import GROWTH, from_here
from pcm_jax.merging.robust.weights import (
    dcs_scale,
    max_mixture_weight,
    null_crossover,
    switch,
    truncated_weight,
)
from pcm_jax.pipeline import merge
from pcm_jax.selection import METHODS
from pcm_jax.simulation import simulate_city

PHI, GATE = 5.0, float(chi2.ppf(0.99, 3))


def se2(*rows):
    """Poses from x, y, θ."""
    rows = np.array(rows, float)
    translation = np.column_stack([rows[:, :2], np.zeros(len(rows))])
    turned = np.column_stack([np.zeros((len(rows), 2)), rows[:, 2]])
    return lie.compose(lie.exp(jaxlie.SE2, translation), lie.exp(jaxlie.SE2, turned))


# Kernels


def test_scales_worked_by_hand():
    squared = np.array([0.0, 5.0, 15.0, 45.0])
    np.testing.assert_allclose(dcs_scale(squared, PHI), [1.0, 1.0, 0.5, 0.2])
    np.testing.assert_allclose(switch(squared, PHI), [1.0, 0.5, 0.25, 0.1])
    # γ² = 4, μ = 1: from 2 to 8, between them 2√2/χ − 1.
    squared = np.array([0.0, 2.0, 4.0, 8.0, 100.0])
    expected = [1.0, 1.0, np.sqrt(2.0) - 1.0, 0.0, 0.0]
    np.testing.assert_allclose(truncated_weight(squared, 4.0, 1.0), expected, atol=1e-15)
    np.testing.assert_array_equal(max_mixture_weight(squared, 4.0, 0.1), [1, 1, 1, 0.1, 0.1])


def test_weights_from_poses_that_are_believed_worked_by_hand():
    """The largest χ² of 8 and γ² = 4: μ = 4 / (2·8 − 4) = 1/3, then 1.4 times that."""
    update = from_here(4.0).update
    squared = np.array([0.5, 1.0, 4.0, 8.0])
    weights, control = update(squared, None)
    assert control == pytest.approx(1.0 / 3.0)
    # Between γ² μ / (μ + 1) = 1 and 16: 4/3 / χ − 1/3.
    partly = 4.0 / 3.0 / np.sqrt(squared) - 1.0 / 3.0
    np.testing.assert_allclose(weights, [1.0, 1.0, partly[2], partly[3]], rtol=1e-12)
    assert update(squared, control)[1] == pytest.approx(GROWTH / 3.0)
    weights, control = update(np.array([0.0, 1.9, 2.0]), None)
    assert weights.tolist() == [1.0, 1.0, 1.0] and np.isinf(control)
    assert update(np.array([3.9, 4.1]), control)[0].tolist() == [1.0, 0.0]


def test_the_first_cost_is_that_of_the_start_by_the_first_weights():
    one = simulate_city(seed=3, poses=60, robots=1).graph.maps[0]
    doubted = np.flatnonzero(~odometry_edges(one))
    reweighting = from_here(chi2_gate(0.5, 3))
    turns = robust.reweighted(
        one, doubted, reweighting, solver="levenberg-marquardt", engine="blocks"
    )
    parts = one.tail, one.head, lie.as_numpy(one.measurement), np.asarray(one.information)
    squared = robust.squared_residuals(lie.as_numpy(one.poses), *parts)
    weights = np.ones(one.num_edges)
    weights[doubted] = reweighting.update(squared[doubted], None)[0]
    assert turns.iterations > 1 and len(doubted) > 3
    assert turns.initial_cost == pytest.approx(0.5 * weights @ squared, rel=1e-6)


@pytest.mark.parametrize(
    "kernel",
    [
        lambda q: dcs_scale(q, PHI),
        lambda q: switch(q, PHI),
        lambda q: truncated_weight(q, 4.0, 0.3),
        lambda q: max_mixture_weight(q, 4.0, 0.1),
    ],
)
def test_kernels_are_the_same_traced(kernel):
    squared = np.linspace(0.0, 30.0, 13)
    np.testing.assert_allclose(jax.jit(kernel)(squared), kernel(squared), atol=1e-14)


def test_reweighting_by_s_squared_is_a_known_cost():
    """The derivative of the robust cost by χ² is the weight."""
    squared = jnp.linspace(0.5, 60.0, 16)

    def dcs_cost(q):
        return jnp.where(q <= PHI, q, (3.0 * PHI * q - PHI**2) / (PHI + q))

    derivatives = jax.jit(jax.vmap(jax.grad(dcs_cost)))(squared)
    np.testing.assert_allclose(derivatives, dcs_scale(squared, PHI) ** 2, rtol=1e-12)
    host = np.asarray(squared)
    s = dcs_scale(host, PHI)
    published = s**2 * host + PHI * (1.0 - s) ** 2
    np.testing.assert_allclose(published, np.minimum(host, PHI), rtol=1e-12)


def test_the_switch_is_the_best_one():
    grid = np.linspace(0.0, 1.0, 100_001)
    for squared in (0.3, 5.0, 80.0):
        best = grid[np.argmin(grid**2 * squared + PHI * (1.0 - grid) ** 2)]
        np.testing.assert_allclose(switch(np.array(squared), PHI), best, atol=1e-5)


def test_truncated_weights_approach_the_step():
    squared = np.array([0.0, 3.9, 4.1, 50.0])
    np.testing.assert_array_equal(truncated_weight(squared, 4.0, 1e6), [1, 1, 0, 0])


@pytest.mark.parametrize("null_weight", [0.05, 0.5, 0.9])
def test_the_crossover_is_where_the_mixture_changes_component(null_weight):
    crossover = null_crossover(1e-3, null_weight, 3)
    for squared, inlier in ((0.999 * crossover, True), (1.001 * crossover, False)):
        r = np.array([np.sqrt(squared), 0.0, 0.0])
        likely = np.log(1 - null_weight) + multivariate_normal(np.zeros(3)).logpdf(r)
        null = np.log(null_weight) + multivariate_normal(np.zeros(3), 1e3 * np.eye(3)).logpdf(r)
        assert (likely > null) == inlier


# Worlds


def chains(count, length, anchors, sigma=1e-3):
    """Robots that drive 1 m steps along their own x axis; true poses, and maps in own frames."""
    path = se2(*((step, 0.0, 0.1 * step) for step in range(length)))
    maps = tuple(
        PoseGraph.from_trajectory(path, sigma_translation=sigma, sigma_rotation=sigma)
        for _ in range(count)
    )
    placed = [lie.compose(lie.take(anchors, np.full(length, r)), path) for r in range(count)]
    return maps, placed


def closures_between(placed, rows, sigma=0.1):
    """Closures (a, i, b, k, error): the true relative pose, times exp(error)."""
    a, i, b, k = (np.array([row[column] for row in rows]) for column in range(4))
    tails = lie.stack([lie.take(placed[r], p) for r, p in zip(a, i, strict=True)])
    heads = lie.stack([lie.take(placed[r], p) for r, p in zip(b, k, strict=True)])
    error = lie.exp(jaxlie.SE2, np.array([row[4] for row in rows], float))
    return LoopClosures.from_arrays(
        robot_a=a,
        pose_a=i,
        robot_b=b,
        pose_b=k,
        measurement=lie.compose(lie.between(tails, heads), error),
        information=np.tile(np.eye(3) / sigma**2, (len(rows), 1, 1)),
    )


FINE, TRUTH = (0.0, 0.0, 0.0), np.array([True, True, False, True, False, True])
FAR = se2((0.0, 0.0, 0.0), (300.0, -200.0, 2.0))


@pytest.fixture(scope="module")
def far_world():
    """The second robot's frame 360 m from the first's; four true closures and two false ones."""
    maps, placed = chains(2, 6, FAR)
    rows = [
        (0, 0, 1, 5, FINE),
        (0, 1, 1, 0, FINE),
        (0, 2, 1, 2, (20.0, -7.0, 0.4)),
        (0, 3, 1, 1, FINE),
        (0, 4, 1, 3, (-9.0, 30.0, -1.0)),
        (0, 5, 1, 4, FINE),
    ]
    return MultiRobotGraph(maps, closures_between(placed, rows))


def near(anchors, *by):
    return lie.compose(anchors, se2((0.0, 0.0, 0.0), by))


@pytest.mark.parametrize("method", ["dcs", "switchable"])
def test_from_the_identity_everything_is_rejected(far_world, method):
    result = merge(far_world, method=method, optimized=True)
    assert not result.accepted.any()
    assert result.groups == ((0,), (1,))
    assert result.robust.converged
    assert (result.robust.scale < 1e-2).all()
    assert (result.robust.squared > 1e4).all()
    for own, merged in zip(far_world.maps, result.graph.maps, strict=True):
        np.testing.assert_array_equal(lie.as_matrix(own.poses), lie.as_matrix(merged.poses))
    # Where the solve left them: first poses still together, not 360 m apart.
    first = [lie.as_matrix(lie.take(one.poses, 0)) for one in result.robust.maps]
    assert np.abs(np.asarray(first[0]) - np.asarray(first[1])).max() < 60.0


def test_undamped_steps_follow_the_nearest_closures(far_world):
    result = merge(far_world, method="dcs", optimized=True, solver="gauss-newton")
    assert result.robust.squared.min() < 3.0 * PHI
    assert result.robust.converged


@pytest.mark.parametrize("method", ROBUST_METHODS)
@pytest.mark.parametrize("by", [(0.0, 0.0, 0.0), (0.1, -0.1, 0.01)])
def test_from_the_truth_the_true_ones_are_accepted(far_world, method, by):
    result = merge(far_world, method=method, optimized=True, anchors=near(FAR, *by))
    np.testing.assert_array_equal(result.accepted, TRUTH)
    assert result.groups == ((0, 1),)
    assert result.solution.converged
    np.testing.assert_allclose(lie.as_matrix(result.anchors), lie.as_matrix(FAR), atol=0.02)
    assert (result.robust.squared[TRUTH] < 1.0).all()
    assert (result.robust.squared[~TRUTH] > 1e3).all()


@pytest.mark.parametrize("start", ["closures", "identity"])
def test_graduated_non_convexity_needs_no_good_start(far_world, start):
    result = merge(far_world, method="gnc", optimized=True, initial=start)
    np.testing.assert_array_equal(result.accepted, TRUTH)
    assert set(result.robust.scale) == {0.0, 1.0}


def test_graduated_non_convexity_outlasts_maps_that_spring_back():
    """All closures together bend these maps; at the next weights each is worse than any before."""
    world = simulate_city(seed=4, poses=100, blocks=4, inliers=8, aliased_groups=0, random=4)
    result = merge(world.graph, method="gnc")
    np.testing.assert_array_equal(result.accepted, world.is_true)


def scalar_fixed_point(places, weigh):
    """t of Σ w(χ²) (t − z) = 0 with χ² = 100 (t − z)², near 0.05."""
    places = np.array(places)
    return brentq(lambda t: (weigh(100.0 * (t - places) ** 2) * (t - places)).sum(), 0.0, 0.3)


@pytest.mark.parametrize(
    ("method", "options", "weigh"),
    [
        ("dcs", {"phi": PHI}, lambda q: dcs_scale(q, PHI) ** 2),
        ("switchable", {}, lambda q: switch(q, GATE) ** 2),
        (
            "max-mixture",
            {"null_scale": 0.1},
            lambda q: max_mixture_weight(q, -3.0 * np.log(0.1) / 0.9, 0.1),
        ),
        ("gnc", {}, lambda q: q <= GATE),
    ],
)
def test_the_answer_of_one_unknown(method, options, weigh):
    """First poses measured 0, 0.1 and 1 m apart: a scalar equation, solved by bisection."""
    places = [0.0, 0.1, 1.0]
    maps, placed = chains(2, 2, se2((0, 0, 0), (0, 0, 0)))
    rows = [(0, 0, 1, 0, (place, 0.0, 0.0)) for place in places]
    graph = MultiRobotGraph(maps, closures_between(placed, rows))
    result = merge(graph, method=method, optimized=True, **options)
    assert result.accepted.tolist() == [True, True, False]
    found = np.asarray(lie.as_matrix(result.anchors))[1, :2, 2]
    expected = scalar_fixed_point(places, weigh)
    np.testing.assert_allclose(found, [expected, 0.0], atol=2e-4)
    squared = 100.0 * (expected - np.array(places)) ** 2
    np.testing.assert_allclose(result.robust.squared, squared, rtol=0.02)
    cost = 0.5 * (result.robust.scale**2 * result.robust.squared).sum()
    np.testing.assert_allclose(result.solution.cost, cost, rtol=1e-3)
    assert result.solution.normalized_chi2 == pytest.approx(2.0 * cost / 3.0, rel=1e-3)


def test_robots_that_only_rejected_closures_connect_are_apart():
    anchors = se2((0, 0, 0), (40.0, 0.0, 1.0), (60.0, 10.0, -1.0))
    maps, placed = chains(3, 4, anchors)
    rows = [
        (0, 0, 1, 0, (-40.0, 3.0, 1.0)),
        (0, 2, 1, 3, (5.0, 30.0, -1.0)),
        *((2, i, 1, 3 - i, FINE) for i in range(4)),
    ]
    graph = MultiRobotGraph(maps, closures_between(placed, rows))
    result = merge(graph, method="dcs", optimized=True, anchors=anchors)
    assert result.accepted.tolist() == [False, False, True, True, True, True]
    assert result.groups == ((0,), (1, 2))
    for robot in (0, 1):  # each the first of its group
        np.testing.assert_allclose(
            lie.as_matrix(lie.take(result.anchors, robot)), np.eye(3), atol=1e-9
        )
    expected = lie.between(lie.take(anchors, 1), lie.take(anchors, 2))
    found = lie.take(result.anchors, 2)
    np.testing.assert_allclose(lie.as_matrix(found), lie.as_matrix(expected), atol=0.02)
    report = result.report()
    assert report["method"] == "dcs"
    assert (report["confidence"], report["gate"]) == (0.99, result.gate)
    assert [pair["accepted"] for pair in report["robot_pairs"]] == [0, 4]
    assert [pair["optimal"] for pair in report["robot_pairs"]] == [None, None]
    assert result.selection is None


def test_too_few_accepted_are_none(far_world):
    options = {"method": "dcs", "optimized": True, "anchors": FAR}
    assert merge(far_world, minimum_inliers=4, **options).accepted.sum() == 4
    fewer = merge(far_world, minimum_inliers=5, **options)
    assert not fewer.accepted.any()
    assert fewer.robust.accepted.sum() == 4


def test_weights_that_do_not_settle_are_told(far_world, monkeypatch):
    monkeypatch.setattr(robust, "MOST_TURNS", 3)
    with pytest.warns(InputWarning, match="did not settle in 3 turns"):
        result = merge(far_world, method="gnc", optimized=True)
    assert not result.solution.converged


def test_squared_residuals_in_space():
    """Against matrices' logarithms, in SE(3)."""
    generator = np.random.default_rng(0)
    poses = lie.exp(jaxlie.SE3, generator.normal(size=(4, 6)))
    root = generator.normal(size=(3, 6, 6))
    information = root @ root.transpose(0, 2, 1) + np.eye(6)
    measurement = lie.exp(jaxlie.SE3, generator.normal(size=(3, 6)))
    tail, head = np.array([0, 3, 2]), np.array([1, 2, 0])
    found = robust.squared_residuals(poses, tail, head, measurement, information)
    for u, (i, j) in enumerate(zip(tail, head, strict=True)):
        X, Y = (jaxlie.SE3(poses.wxyz_xyz[p]) for p in (i, j))
        z = jaxlie.SE3(measurement.wxyz_xyz[u])
        r = (z.inverse() @ X.inverse() @ Y).log()
        np.testing.assert_allclose(found[u], r @ information[u] @ r, rtol=1e-9)


def test_bad_options(far_world):
    for options, message in (
        ({"method": "dcs", "ph": 1.0}, "ph: not an option of method 'dcs', expected one of .*phi"),
        ({"method": "gnc", "time_limit": 1.0}, "time_limit: not an option of method 'gnc'"),
        ({"method": "all", "phi": 1.0}, "phi: not an option that goes with method 'all'"),
        ({"accepted": TRUTH, "phi": 1.0}, "phi: not an option that goes with accepted="),
        ({"method": "dcs", "phi": 0.0}, "phi: 0.0, expected above 0"),
        ({"method": "switchable", "prior": -1.0}, "prior: -1.0, expected above 0"),
        ({"method": "max-mixture", "null_scale": 0.5}, "null_scale: 0.5, expected above 0"),
        ({"method": "max-mixture", "null_weight": 1.0}, "null_weight: 1.0, expected above 0"),
        ({"method": "dcs", "initial": "truth"}, "initial: 'truth', expected one of identity"),
        ({"method": "dcs", "anchors": np.eye(3)}, "anchors: ndarray, expected SE2 \\[2\\]"),
        ({"method": "dcs", "anchors": se2((0, 0, 0))}, "anchors: shape \\[1\\], expected SE2"),
        ({"method": "dcs", "minimum_inliers": -1}, "minimum_inliers: -1, expected at least 0"),
        ({"method": "dsc"}, "method: 'dsc', expected one of pcm-exact.*max-mixture, all"),
    ):
        with pytest.raises(InputError, match=message):
            merge(far_world, optimized=True, **options)


def test_the_command_line_names_every_method(capsys):
    with pytest.raises(SystemExit):
        parser().parse_args(["merge", "--help"])
    text = " ".join(capsys.readouterr().out.split()).replace("- ", "-")
    for name in (*METHODS, *ROBUST_METHODS, "all"):
        assert name in text
