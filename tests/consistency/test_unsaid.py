"""Closures that leave directions unsaid: their q², its degrees of freedom, and all that follows."""

import dataclasses

import jax
import jaxlie
import numpy as np
import pytest
from consistency_worlds import random_world
from planar_worlds import PLANE, information_in_space, planar_world
from scipy import stats
from scipy.linalg import null_space

import pcm_jax as pcm
from pcm_jax import lie
from pcm_jax.consistency import joint_consistency, squared_rows
from pcm_jax.consistency.limit import comparable, gates, limit
from pcm_jax.consistency.mahalanobis import freedom_of, limits_of
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files.formats.jrl import write_jrl
from pcm_jax.graph.unsaid import held, noise_of, ranks, told

POSITION, NO_TILT, PLANAR = (0, 1, 2), (0, 1, 2, 5), (0, 1, 5)


def silenced(closures, said, rows=slice(None)):
    """Closures whose information is zero but for the axes said."""
    information = np.array(closures.information)
    keep = np.isin(np.arange(information.shape[-1]), said)
    information[rows] *= keep[:, None] & keep
    return dataclasses.replace(closures, information=information)


def problem_of(group, said, seed=2, count=8, rows=slice(None)):
    """A problem of random maps and closures that say some axes alone."""
    map_a, map_b, closures = random_world(group, seed=seed, count=count)
    return pcm.consistency_problem(map_a, map_b, silenced(closures, said, rows))


def by_projection(problem, u, v):
    """q² and degrees of freedom by SciPy's null space: M restricted to what both closures say."""
    take = lambda leaf, k: np.asarray(leaf)[k]  # noqa: E731
    seen = [
        lie.compose(
            lie.take(lie.as_numpy(problem.pose_a), k),
            lie.take(lie.as_numpy(problem.measurement), k),
        )
        for k in (u, v)
    ]
    at = [
        lie.compose(one, lie.inverse(lie.take(lie.as_numpy(problem.pose_b), k)))
        for one, k in zip(seen, (u, v), strict=True)
    ]
    d = problem.measurement_covariance.shape[-1]
    adjoints = [np.asarray(lie.adjoint(one)) for one in seen]
    turn = np.asarray(lie.adjoint(at[1]))
    total = unpacked(take(problem.relative_covariance_a.T, problem.row_a[u])[problem.row_a[v]], d)
    side_b = unpacked(take(problem.relative_covariance_b.T, problem.row_b[u])[problem.row_b[v]], d)
    total = total + turn @ side_b @ turn.T
    columns = []
    for adjoint, k in zip(adjoints, (u, v), strict=True):
        total = total + adjoint @ take(problem.measurement_covariance, k) @ adjoint.T
        columns.append(adjoint @ take(problem.free, k))
    basis = null_space(np.hstack(columns).T, rcond=1e-9)
    error = basis.T @ np.asarray(lie.log(lie.compose(at[1], lie.inverse(at[0]))))
    return error @ np.linalg.solve(basis.T @ total @ basis, error), basis.shape[1]


def unpacked(packed, d):
    """A symmetric matrix from its lower triangle, row by row."""
    matrix = np.zeros((d, d))
    matrix[np.tril_indices(d)] = packed
    return matrix + np.tril(matrix, -1).T


@pytest.mark.parametrize(
    "group, said, freedom",
    [
        (jaxlie.SE3, POSITION, 1),  # the distance of two points
        (jaxlie.SE3, NO_TILT, 2),
        (jaxlie.SE3, (3, 4, 5), 3),
        (jaxlie.SE2, (0, 1), 1),
        (jaxlie.SE2, (2,), 1),
    ],
)
def test_the_limit_is_m_restricted_to_what_both_closures_say(group, said, freedom):
    problem = problem_of(group, said)
    squared, degrees = limits_of(problem)
    for u, v in ((0, 1), (1, 0), (2, 7), (5, 3)):
        expected, dof = by_projection(problem, u, v)
        assert dof == freedom == degrees[u, v]
        np.testing.assert_allclose(squared[u, v], expected, rtol=1e-7)


def test_a_closure_that_says_all_is_judged_by_what_the_other_says():
    problem = problem_of(jaxlie.SE3, POSITION, rows=slice(0, 4))
    squared, degrees = limits_of(problem)
    np.testing.assert_array_equal(np.diag(degrees), 6)
    expected, dof = by_projection(problem, 6, 1)
    assert dof == degrees[6, 1] == 3 and degrees[6, 7] == 6 and degrees[0, 1] == 1
    np.testing.assert_allclose(squared[6, 1], expected, rtol=1e-9)
    whole = problem_of(jaxlie.SE3, (0, 1, 2, 3, 4, 5))
    np.testing.assert_allclose(squared[6, 7], np.asarray(pcm.squared_mahalanobis(whole))[6, 7])


def test_the_limit_of_one_number():
    """r² / M, or nothing of no degree, by hand."""
    symmetric, error = ((np.array([4.0]),),), (np.array([6.0]),)
    assert limit(symmetric, error, ()) == ([9.0], [1.0])
    assert limit(symmetric, error, [(np.array([2.0]),)]) == ([0.0], [0.0])


@pytest.mark.slow
@pytest.mark.parametrize("group, said", [(jaxlie.SE2, (0, 1)), (jaxlie.SE3, NO_TILT)])
def test_the_definition_has_the_same_limit(group, said):
    problem = problem_of(group, said, rows=slice(0, 5))
    closed, defined = limits_of(problem), limits_of(problem, kernel="jacfwd")
    np.testing.assert_array_equal(closed.freedom, defined.freedom)
    np.testing.assert_allclose(closed.squared, defined.squared, rtol=1e-9, atol=1e-11)


def test_the_limit_is_where_ever_larger_covariances_lead():
    problem = problem_of(jaxlie.SE2, (0, 1))
    limit = np.asarray(pcm.squared_mahalanobis(problem))
    free = np.asarray(problem.free)
    off = []
    for size in (1e3, 1e5):
        large = problem.measurement_covariance + size * free @ free.swapaxes(1, 2)
        finite = dataclasses.replace(problem, measurement_covariance=large, free=None)
        off.append(np.abs(np.asarray(pcm.squared_mahalanobis(finite)) - limit).max())
    assert off[1] < 1.2e-2 * off[0] and off[1] < 1e-3 * limit.max()


def test_what_stands_for_the_unbounded_variance_does_not_count():
    problem = problem_of(jaxlie.SE3, POSITION)
    free = np.asarray(problem.free)
    other = problem.measurement_covariance + 3.0 * free @ free.swapaxes(1, 2)
    moved = dataclasses.replace(problem, measurement_covariance=other)
    np.testing.assert_allclose(
        pcm.squared_mahalanobis(moved), pcm.squared_mahalanobis(problem), rtol=1e-9
    )


@pytest.mark.slow
def test_the_compiled_kernel_is_that_of_numpy_and_has_a_gradient():
    problem = problem_of(jaxlie.SE2, (0, 1), count=5)

    def total(scale):
        noise = scale * problem.measurement_covariance
        own = dataclasses.replace(problem, measurement_covariance=noise)
        return pcm.squared_mahalanobis(own)[:5, :5].sum()

    step = 1e-5
    numeric = (total(1.0 + step) - total(1.0 - step)) / (2.0 * step)
    value, slope = jax.jit(jax.value_and_grad(total))(1.0)
    np.testing.assert_allclose(value, total(1.0), rtol=1e-10)  # the latter by NumPy
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)


def test_planar_closures_between_maps_in_space_are_judged_as_in_the_plane():
    flat, deep = planar_world(1, false=(3, 8))
    problems = [pcm.consistency_problem(*graph.maps, graph.closures) for graph in (flat, deep)]
    squared, freedom = limits_of(problems[1])
    np.testing.assert_allclose(squared, pcm.squared_mahalanobis(problems[0]), rtol=1e-9, atol=1e-9)
    assert (np.asarray(freedom)[~np.eye(12, dtype=bool)] == 3).all()
    assert (np.asarray(freedom_of(problems[0])) == 3).all()


def test_a_tilt_of_rounding_makes_no_new_direction():
    _, deep = planar_world(1)
    tilted = np.array(lie.parameters(deep.closures.measurement))
    tilted[:, 1:3] += 1e-6 * np.random.default_rng(0).normal(size=(12, 2))
    closures = dataclasses.replace(deep.closures, measurement=jaxlie.SE3(tilted))
    squared, freedom = limits_of(pcm.consistency_problem(*deep.maps, closures))
    straight = pcm.squared_mahalanobis(pcm.consistency_problem(*deep.maps, deep.closures))
    assert (np.asarray(freedom)[~np.eye(12, dtype=bool)] == 3).all()
    np.testing.assert_allclose(squared, straight, rtol=1e-2, atol=1e-3)


@pytest.mark.slow
def test_right_planar_pairs_pass_a_gate_of_their_own_as_often_as_it_says():
    passed, worlds = 0, 200
    gate = float(pcm.chi2_gate(0.95, dof=6))
    for seed in range(worlds):
        _, deep = planar_world(seed, closures=2, poses=6)
        squared, freedom = limits_of(pcm.consistency_problem(*deep.maps, deep.closures))
        passed += comparable(np.asarray(squared), np.asarray(freedom), 6)[0, 1] <= gate
    assert stats.binomtest(int(passed), worlds, 0.95).pvalue > 0.01, passed


def test_gates_of_fewer_degrees_are_as_likely():
    for confidence in (0.11, 0.95, 0.999):
        gate = float(pcm.chi2_gate(confidence, 6))
        expected = [-1.0, *(stats.chi2.ppf(confidence, n) for n in range(1, 7))]
        np.testing.assert_allclose(gates(gate, 6), expected, rtol=1e-10)
        np.testing.assert_allclose(comparable(expected[1:], np.arange(1, 7), 6), gate, rtol=1e-10)
    assert np.isinf(comparable(0.0, 0, 6)) and comparable(5000.0, 3, 6) >= 5000.0


def test_a_pair_with_nothing_in_common_agrees_with_nothing():
    *maps, closures = random_world(jaxlie.SE2, seed=0, count=4)
    map_a, map_b = (pcm.optimize(one).graph for one in maps)
    mixed = silenced(silenced(closures, (2,), [0, 1]), (0, 1), [2, 3])
    evidence = pcm.weigh(pcm.MultiRobotGraph((map_a, map_b), mixed), optimized=True).pairs[0]
    assert evidence.freedom is not None and (evidence.freedom[:2, 2:] == 0).all()
    assert not evidence.consistent(1e6)[:2, 2:].any() and evidence.consistent(1e6)[0, 1]


@pytest.fixture(scope="module")
def worlds():
    """A world with false closures as (flat, deep), and the evidence of either."""
    graphs = planar_world(5, closures=16, false=(2, 9, 13))
    return graphs, [pcm.weigh(graph, optimized=True) for graph in graphs]


def test_selection_and_chance_are_those_of_the_plane(worlds):
    _, (flat, deep) = worlds
    found = [pcm.select(evidence, confidence=0.99) for evidence in (flat, deep)]
    assert not found[1].accepted[[2, 9, 13]].any() and found[1].accepted.sum() >= 11
    np.testing.assert_array_equal(found[0].accepted, found[1].accepted)
    chance = [one.pairs[0].verdict.chance for one in found]
    assert chance[0].places == chance[1].places and chance[1].p_value <= 0.01
    for method in ("ransac", "scgp", "clipper", "pcm-heuristic"):
        own = pcm.select(deep, method=method, confidence=0.99, minimum_inliers=2)
        assert not own.accepted[[2, 9, 13]].any() and own.accepted.sum() >= 9, method


def test_shuffles_left_in_order_are_the_graph_itself(worlds):
    pair = worlds[1][1].pairs[0]
    gate = float(pcm.chi2_gate(0.99, 6))
    pairs = pair.shuffles(gate).weigh(np.arange(16)[None])
    found = np.zeros((16, 16), bool)
    found[pairs.u, pairs.v] = found[pairs.v, pairs.u] = True
    np.testing.assert_array_equal(found, pair.consistent(gate))
    larger = np.maximum(pair.comparable, pair.comparable.T)
    np.testing.assert_allclose(pairs.squared, larger[pairs.u, pairs.v], rtol=1e-9)


def test_streaming_finds_the_same_graph():
    *maps, closures = random_world(jaxlie.SE2, seed=4, count=30)
    map_a, map_b = (pcm.optimize(one).graph for one in maps)
    closures = silenced(closures, (0, 1), slice(0, 20))
    graph = pcm.MultiRobotGraph((map_a, map_b), closures)
    gate = float(pcm.chi2_gate(0.9, 3))
    expected = pcm.weigh(graph, optimized=True).pairs[0].consistent(gate)
    streamed = pcm.stream_consistency_graph(map_a, map_b, closures, gate)
    np.testing.assert_array_equal(streamed.dense(), expected)
    assert 0 < expected.sum() < expected.size - 30


def test_the_joint_test_is_that_of_the_plane(worlds):
    _, (flat, deep) = worlds
    for chosen in ([0, 1], [0, 1, 4, 6], None):
        one, other = (joint_consistency(evidence.pairs[0], chosen) for evidence in (flat, deep))
        assert one.dof == other.dof
        np.testing.assert_allclose(one.chi2, other.chi2, rtol=1e-8)
        np.testing.assert_allclose(one.contributions, other.contributions, rtol=1e-5)
        np.testing.assert_allclose(one.covariance, other.covariance[PLANE], rtol=1e-6, atol=1e-12)
        assert (np.diag(other.covariance)[[2, 3, 4]] > 1e5).all()


def test_a_merge_is_that_of_the_plane_and_says_what_is_not_tied(worlds):
    (flat, deep), _ = worlds
    accepted = np.delete(np.arange(16), [2, 9, 13])
    one, other = (pcm.merge(graph, accepted=accepted) for graph in (flat, deep))
    position = [np.asarray(lie.translation(m.graph.maps[1].poses)) for m in (one, other)]
    np.testing.assert_allclose(position[0], position[1][:, :2], atol=1e-6)
    np.testing.assert_allclose(position[1][:, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(other.solution.cost, one.solution.cost, rtol=1e-6)
    np.testing.assert_allclose(
        other.solution.normalized_chi2, one.solution.normalized_chi2, rtol=1e-6
    )
    told = [line for line in other.warnings if "tied by no accepted closure" in line]
    assert (
        len(told) == 1 and "robot 'b': 3 of 6 directions of its place (z, roll, pitch)" in told[0]
    )
    assert other.warnings == other.report()["warnings"] and not one.warnings
    np.testing.assert_array_equal(
        other.graph.closures.information, deep.closures.information[accepted]
    )


def test_positions_at_several_places_tie_a_map():
    rng = np.random.default_rng(0)
    map_a, map_b, closures = random_world(jaxlie.SE3, seed=7, count=6)
    exact = lie.between(
        lie.take(lie.as_numpy(map_a.poses), closures.pose_a),
        lie.take(lie.as_numpy(map_b.poses), closures.pose_b),
    )
    moved = lie.compose(exact, lie.exp(jaxlie.SE3, 1e-3 * rng.normal(size=(6, 6))))
    closures = silenced(dataclasses.replace(closures, measurement=moved), POSITION)
    graph = pcm.MultiRobotGraph((map_a, map_b), closures)
    merged = pcm.merge(graph, accepted=np.arange(6))
    assert not [line for line in merged.warnings if "tied" in line]


REFUSED = {
    "jcbb": (lambda deep, graph: pcm.select(deep, method="jcbb"), "method 'jcbb': "),
    "gnc": (lambda deep, graph: pcm.merge(graph, method="gnc"), "method: 'gnc' with 16 closures"),
    "float32": (lambda deep, graph: deep.pairs[0].problem().astype(np.float32), "dtype: float32"),
    "rows": (lambda deep, graph: squared_rows(deep.pairs[0].problem(), np.arange(2)), "problem: "),
    "differentiable": (
        lambda deep, graph: pcm.merge_differentiable(graph, np.ones(16)),
        r"closures\[0\]: information of rank 3",
    ),
    "two sets": (
        lambda deep, graph: pcm.alignment_difference(deep.pairs[0], [0, 1], [4, 5]),
        "alignment_difference: 4 of 4 closures have singular information",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_judge_them_says_so(name, worlds):
    call, told = REFUSED[name]
    with pytest.raises(InputError, match=told):
        call(worlds[1][1], worlds[0][1])


def test_ranks_are_told_from_rounding_and_from_negative_eigenvalues():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 4)) * np.array([1e3, 1e3, 1e3, 1.0, 1.0, 1.0])[:, None]
    made = np.stack([root @ root.T, np.diag([1e8, 1.0, 0, 0, 0, 1e-4]), np.eye(6), -np.eye(6)])
    np.testing.assert_array_equal(ranks(made), [4, 3, 6, -1])
    covariance, free = noise_of(made[:3])
    assert free is not None and free.shape == (3, 6, 3)
    np.testing.assert_allclose(made[0] @ free[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(made[0] @ covariance[0] @ made[0], made[0], rtol=1e-6, atol=1e-6)
    assert noise_of(made[2:3])[1] is None
    np.linalg.cholesky(held(made[:3]))
    moved = np.abs(held(made[:3]) - made[:3]).max(axis=(1, 2))
    assert (moved <= 1.001e-9 * np.linalg.eigvalsh(made[:3])[:, -1]).all() and moved[1] > 0.0
    np.testing.assert_array_equal(held(made[2:3]), made[2:3])


def test_turned_round_a_closure_leaves_as_much_unsaid():
    map_a, map_b, closures = random_world(jaxlie.SE3, seed=0, count=5)
    ends = (
        lie.take(lie.as_numpy(m.poses), k)
        for m, k in ((map_a, closures.pose_a), (map_b, closures.pose_b))
    )
    exact = lie.between(*ends)  # else noise tilts the axes, seen from one end or the other
    closures = silenced(dataclasses.replace(closures, measurement=exact), NO_TILT)
    turned = closures._flipped(np.ones(5, bool))
    assert (closures.rank == 4).all() and (turned.rank == 4).all()
    there = limits_of(pcm.consistency_problem(map_a, map_b, closures))
    swapped = pcm.consistency_problem(map_b, map_a, turned)
    back = limits_of(swapped)
    np.testing.assert_array_equal(there.freedom, back.freedom)


def test_one_line_says_how_many_closures_say_what():
    information = information_in_space(np.tile(np.eye(3), (3, 1, 1)))
    information = np.concatenate([information, np.eye(6)[None]])
    assert list(told(information)) == [
        "3 of 4 closures say 3 of 6 degrees of freedom (x, y, yaw): judged with as many as two of"
        " them have in common"
    ]
    assert not list(told(information[3:]))


def test_information_of_a_closure_may_be_singular_but_not_empty_nor_a_maps():
    _, deep = planar_world(0, closures=2)
    given = {
        name: getattr(deep.closures, name) for name in ("robot_a", "pose_a", "robot_b", "pose_b")
    }
    given["measurement"] = deep.closures.measurement
    for wrong in (np.zeros((2, 6, 6)), np.tile(np.diag([1.0, 1, 1, 1, 1, -1e-3]), (2, 1, 1))):
        with pytest.raises(InputError, match="information\\[0\\]: information is not positive"):
            pcm.LoopClosures.from_arrays(information=wrong, **given)
    with pytest.raises(InputError, match="rank 3 of 6"):
        pcm.PoseGraph.from_arrays(
            tail=[0],
            head=[1],
            measurement=lie.take(deep.closures.measurement, [0]),
            information=deep.closures.information[:1],
        )


LINES = "0.0 0.0 0.0 0 0 0 1 100 0 0 0 0 0 100 0 0 0 0 {z} 0 0 0 {z} 0 0 {z} 0 100"


def test_files_with_planar_closures_are_read_and_told(tmp_path):
    key = [[ord(letter) << 56 | k for k in range(2)] for letter in "ab"]
    whole, planar = LINES.format(z=100), LINES.format(z=0)
    text = [f"EDGE_SE3:QUAT {one} {two} {whole}" for one, two in key]
    text += [f"EDGE_SE3:QUAT {key[0][k]} {key[1][k]} {planar}" for k in (0, 1)]
    path = tmp_path / "planar.g2o"
    path.write_text("\n".join(text))
    with pytest.warns(InputWarning, match=r"2 of 2 closures say 3 of 6 .*\(x, y, yaw\)"):
        graph = pcm.read_graph(path)
    assert graph.closures.rank.tolist() == [3, 3]
    pcm.write_g2o(tmp_path / "again.g2o", graph)
    with pytest.warns(InputWarning, match="2 of 2 closures"):
        again = pcm.read_graph(tmp_path / "again.g2o")
    np.testing.assert_array_equal(again.closures.information, graph.closures.information)
    with pytest.warns(InputWarning, match="2 information matrices clipped"):
        assert pcm.read_graph(path, repair="clip").closures.rank.tolist() == [6, 6]
    path.write_text("\n".join([f"EDGE_SE3:QUAT {key[0][0]} {key[0][1]} {planar}", *text[1:]]))
    with pytest.raises(InputError, match=r"planar.g2o:1: .*rank 3 of 6.*--repair clip"):
        pcm.read_graph(path)


def test_what_is_written_says_as_much(tmp_path):
    _, deep = planar_world(0, closures=3, poses=5)
    with pytest.raises(InputError, match=r"closures\[0\]: information of rank 3 has no covariance"):
        write_jrl(tmp_path / "x.jrl", deep)
    assert not list(tmp_path.iterdir())


def test_information_whose_inverse_is_beyond_floats_says_nothing():
    assert ranks(np.stack([1e-310 * np.eye(6), np.eye(6)])).tolist() == [0, 6]
