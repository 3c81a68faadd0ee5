"""Explanations, against the definitions, planted mistakes and what merging really does."""

import dataclasses
import functools
from types import SimpleNamespace

import jaxlie
import numpy as np
import pytest
from scipy.linalg import block_diag

from pcm_jax import (
    InputError,
    LoopClosures,
    MapCovariance,
    MultiRobotGraph,
    PoseGraph,
    chi2_gate,
    consistency_graph,
    consistency_problem,
    lie,
    merge,
    squared_mahalanobis,
    weigh,
)
from pcm_jax.consistency.definition import loop_error
from pcm_jax.integrity import STANDINGS, explain
from pcm_jax.integrity._loops import Loops
from pcm_jax.integrity._sentences import _accepted, confidence, number
from pcm_jax.integrity.residuals import Fit, StrainedEdge
from pcm_jax.simulation import simulate_city, simulate_sessions

SIMULATED = {"SE2": simulate_city, "SE3": simulate_sessions}


@functools.cache
def evidence_and_result(group):
    """Three robots among false closures, weighed and merged."""
    world = SIMULATED[group](
        **({"robots": 3} if group == "SE2" else {"sessions": 3}),
        seed=4,
        poses=60,
        inliers=8,
        aliased_groups=1,
        aliased_size=3,
        random=12,
    )
    evidence = weigh(world.graph)
    return evidence, merge(evidence, confidence=0.9)


both_groups = pytest.mark.parametrize("group", ["SE2", "SE3"])


@functools.cache
def loops_of(group):
    evidence, _ = evidence_and_result(group)
    pair = evidence.pairs[0]
    u, v = np.nonzero(~np.eye(len(pair), dtype=bool))
    return pair, u, v, Loops(pair.covariances, pair.measured).misses(u, v)


@both_groups
def test_loops_of_chosen_pairs_are_those_of_q(group):
    pair, u, v, missed = loops_of(group)
    larger = np.maximum(pair.squared, pair.squared.T)
    np.testing.assert_allclose(missed.squared, larger[u, v], rtol=1e-9)
    rows, columns = np.arange(len(pair)), np.array([0, 5, 3])
    own = Loops(pair.covariances, pair.measured)
    np.testing.assert_allclose(own.squared(rows, columns), larger[:, columns], rtol=1e-9)
    np.testing.assert_allclose(own.squared(columns, rows), larger[columns], rtol=1e-9)


@both_groups
def test_portions_do_not_change_the_loops(group, monkeypatch):
    pair, u, v, missed = loops_of(group)
    monkeypatch.setattr("pcm_jax.integrity._loops.PARTNERS", 3)
    monkeypatch.setattr("pcm_jax.integrity._loops.PAIRS", 40)
    cut = Loops(pair.covariances, pair.measured).misses(u, v)
    for one, other in zip(missed, cut, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.parametrize(("partners", "pairs"), [(2, 40), (3, 10**6), (10**6, 25)])
def test_portions_are_of_few_partners_and_few_pairs(monkeypatch, partners, pairs):
    """All pairs once; one more partner would be too many, or have too many pairs."""
    pair, *_ = loops_of("SE2")
    monkeypatch.setattr("pcm_jax.integrity._loops.PARTNERS", partners)
    monkeypatch.setattr("pcm_jax.integrity._loops.PAIRS", pairs)
    of = np.random.default_rng(0).integers(0, 11, 150)
    portions = Loops(pair.covariances, pair.measured)._portions(of)
    assert sorted(np.concatenate(portions).tolist()) == list(range(150))
    sizes, each = [len(some) for some in portions], [np.unique(of[some]) for some in portions]
    assert np.concatenate(each).tolist() == list(range(11))
    for size, held, following in zip(sizes, each, [*each[1:], []], strict=True):
        assert size <= pairs and len(held) <= partners
        more = size + np.count_nonzero(of == following[0]) if len(following) else np.inf
        assert more > pairs or len(held) == partners


def derivative(function, size, h=1e-3):
    """Of a function of `[k, size]` errors at zero, by differences of fourth order."""
    moves = h * np.eye(size)
    near, far = (function(k * moves) - function(-k * moves) for k in (1, 2))
    return ((8 * near - far) / (12 * h)).T


@both_groups
def test_misses_and_sigmas_by_differences(group):
    """The loop of eq. 4, its lengths, and their derivatives by each of the seven errors."""
    pair, all_u, all_v, missed = loops_of(group)
    graphs = [covariance.pose_graph for covariance in pair.covariances]
    d = graphs[0].tangent_dim
    space = 2 if d == 3 else 3
    for at in range(0, len(all_u), 37):
        u, v = int(all_u[at]), int(all_v[at])
        if pair.squared[v, u] > pair.squared[u, v]:
            u, v = v, u  # the way in which it fits worse
        closures = pair.measured
        ends = [np.asarray(poses)[[u, v]] for poses in (closures.pose_a, closures.pose_b)]
        joints = [
            MapCovariance(graph).joint(np.unique(two))
            for graph, two in zip(graphs, ends, strict=True)
        ]
        given = [
            [lie.take(lie.as_numpy(graph.poses), int(pose)) for pose in np.unique(two)]
            for graph, two in zip(graphs, ends, strict=True)
        ]
        z = [lie.take(lie.as_numpy(closures.measurement), k) for k in (u, v)]
        noise = [np.linalg.inv(np.asarray(closures.information)[k]) for k in (u, v)]
        sizes = [len(joint) for joint in joints] + [d, d]

        def moved(one, by):
            return lie.compose(one, lie.exp(lie.group_of(one), by))

        def lengths(delta, ends=ends, given=given, z=z, sizes=sizes):
            of_a, of_b, of_u, of_v = np.split(delta, np.cumsum(sizes)[:-1], axis=1)
            placed = []
            for own, poses, two in zip((of_a, of_b), given, ends, strict=True):
                steps = np.split(own, len(poses), axis=1)
                known = [moved(*each) for each in zip(poses, steps, strict=True)]
                placed.append([known[k] for k in np.searchsorted(np.unique(two), two)])
            (x_i, x_j), (y_k, y_l) = placed
            z_u, z_v = (moved(*each) for each in zip(z, (of_u, of_v), strict=True))
            error = loop_error(z_u, lie.between(x_i, x_j), z_v, lie.between(y_l, y_k))
            walked = lie.translation(lie.exp(lie.group_of(z_u), error))
            apart = walked, error[:, space:]
            return np.stack([np.linalg.norm(each, axis=1) for each in apart], axis=1)

        slope = derivative(lengths, sum(sizes))
        covariance = block_diag(*joints, *noise)
        sigma = np.sqrt(np.diagonal(slope @ covariance @ slope.T))
        miss = missed.translation[at], missed.rotation[at]
        np.testing.assert_allclose(miss, lengths(np.zeros((1, sum(sizes))))[0], rtol=1e-7)
        np.testing.assert_allclose(missed.sigma[at], sigma, rtol=1e-6)


@both_groups
def test_shares_are_how_q_falls_as_each_covariance_grows(group):
    """With q² = rᵀM⁻¹r, a part of M that grows by h takes h times its share from q²."""
    pair, u, v, missed = loops_of(group)
    problem = consistency_problem(*pair.maps, pair.measured)
    names = [
        ("relative_covariance_a",),
        ("relative_covariance_b",),
        ("measurement_covariance",),
    ]
    forward = pair.squared[u, v] >= pair.squared[v, u]
    for part, fields in enumerate(names):
        grown = []
        for h in (-1e-5, 1e-5):
            changed = {name: getattr(problem, name) * (1.0 + h) for name in fields}
            squared = np.asarray(squared_mahalanobis(dataclasses.replace(problem, **changed)))
            grown.append(np.where(forward, squared[u, v], squared[v, u]))
        slope = (grown[1] - grown[0]) / 2e-5
        np.testing.assert_allclose(missed.shares[:, part], -slope / missed.squared, atol=1e-7)
    np.testing.assert_allclose(missed.shares.sum(axis=1), 1.0)


@both_groups
def test_counts_and_conflicts_are_those_of_q(group):
    """By loops over the closures, from the distances and the definition alone."""
    evidence, result = evidence_and_result(group)
    told = explain(result)
    assert [one.index for one in told] == list(range(len(result.candidates)))
    assert [pair.verdict.believed for pair in result.selection.pairs].count(True) >= 2
    for pair, decided in zip(evidence.pairs, result.selection.pairs, strict=True):
        closures = pair.closures.tolist()
        believed = decided.verdict.believed
        for row, index in enumerate(closures):
            one = told[index]
            larger = [max(pair.squared[row, k], pair.squared[k, row]) for k in range(len(pair))]
            by = result.accepted[pair.closures] if believed else decided.members
            accepted = [k for k in np.flatnonzero(by) if k != row]
            assert one.among == ("accepted" if believed else "found")
            assert one.of == len(accepted) > 0
            assert one.agrees_with == sum(larger[k] <= result.gate for k in accepted)
            others = [k for k in range(len(pair)) if k != row]
            assert one.agreeing == sum(larger[k] <= result.gate for k in others)
            assert one.candidates == len(pair)
            worst = max(accepted, key=lambda k: larger[k])
            assert one.worst_conflict.index == closures[worst]
            assert one.worst_conflict.squared == pytest.approx(larger[worst])


@both_groups
def test_a_closure_enters_where_it_is_said_to(group):
    evidence, result = evidence_and_result(group)
    seen = 0
    for one in explain(result):
        if one.enters_at > 1.0 - 1e-9:
            continue
        seen += 1
        (pair,) = (p for p in evidence.pairs if one.index in p.closures)
        row = int(np.searchsorted(pair.closures, one.index))
        accepted = result.accepted[pair.closures]
        accepted[row] = False
        for inside, enters in (
            (one.enters_at * (1 + 1e-9), True),
            (one.enters_at * 0.999, False),
        ):
            gate = chi2_gate(min(inside, 1.0 - 1e-12), evidence.tangent_dim)
            assert consistency_graph(pair.squared, gate)[row, accepted].all() == enters
    assert seen > 10


@both_groups
def test_standings_by_their_meaning(group):
    _, result = evidence_and_result(group)
    told = explain(result)
    assert {one.standing for one in told} <= set(STANDINGS)
    assert {"accepted", "isolated", "in the rival set"} <= {one.standing for one in told}
    for one in told:
        assert (one.standing == "accepted") == one.accepted == result.accepted[one.index]
        if one.standing == "isolated":
            assert one.agreeing == 0
        if one.standing == "against all":
            assert one.agrees_with == 0 < one.agreeing
        if one.standing == "near miss":
            assert one.of > one.agrees_with >= one.of / 4
        if one.standing == "in the rival set":
            (pair,) = (p for p in result.selection.pairs if one.index in p.closures)
            assert pair.verdict.rival.members[np.searchsorted(pair.closures, one.index)]


@pytest.mark.slow
@both_groups
def test_streamed_distances_give_the_same(group):
    evidence, result = evidence_and_result(group)
    streamed = weigh(evidence.optimized, optimized=True, memory_limit=0.0)
    assert all(pair.is_streamed for pair in streamed.pairs)
    other = merge(streamed, confidence=0.9)
    for one, two in zip(explain(result), explain(other), strict=True):
        assert one.sentence == two.sentence
        assert (one.standing, one.agreeing) == (two.standing, two.agreeing)
        assert two.worst_conflict.squared == pytest.approx(one.worst_conflict.squared, rel=1e-9)


@both_groups
def test_one_closure_as_among_all(group):
    _, result = evidence_and_result(group)
    for index in (0, 17, len(result.candidates) - 1):
        assert repr(result.explain(index)) == repr(explain(result)[index])
        assert result.explain(index).sentence == explain(result)[index].sentence
    assert [one.index for one in explain(result, [5, 2])] == [5, 2]
    assert explain(result, []) == []


def test_an_index_that_is_not_there():
    _, result = evidence_and_result("SE2")
    last = len(result.candidates) - 1
    with pytest.raises(InputError, match=f"index: {last + 1}, expected 0 … {last}"):
        result.explain(last + 1)
    with pytest.raises(InputError, match="index: -1, expected 0"):
        result.explain(-1)
    with pytest.raises(InputError, match=r"index: 1\.5, expected an integer"):
        result.explain(1.5)
    with pytest.raises(InputError, match=r"index: \[\[0, 1\]\], expected an integer"):
        explain(result, [[0, 1]])


def straight(name, count=30):
    """A robot that drove straight on, measured exactly, sure to 5 cm and a degree a step."""
    values = np.stack([np.ones(count), np.zeros(count), np.arange(count), np.zeros(count)], axis=1)
    graph = PoseGraph.from_trajectory(
        jaxlie.SE2(values), sigma_translation=0.05, sigma_rotation=np.radians(1.0)
    )
    return dataclasses.replace(graph, name=name)


@functools.cache
def planted(turned=False):
    """Two robots side by side 2 m apart; closure 3 is 5 m off, closure 4 by 30 degrees."""
    maps = straight("a"), straight("b")
    group = maps[0].group
    poses = np.array([2, 9, 15, 20, 26, 28])
    values = np.tile([1.0, 0.0, 0.0, 2.0], (6, 1))
    values[3, 2:] += 3.0, 4.0
    values[4, :2] = np.cos(np.pi / 6), np.sin(np.pi / 6)
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(6, int),
        pose_a=poses,
        robot_b=np.ones(6, int),
        pose_b=poses,
        measurement=group(values),
        information=np.tile(np.diag([400.0, 400.0, 3000.0]), (6, 1, 1)),
    )
    if turned:
        closures, _ = closures.between(1, 0)
    return merge(MultiRobotGraph(maps, closures), minimum_inliers=2)


@pytest.mark.parametrize("turned", [False, True])
def test_planted_mistakes_are_measured(turned):
    result = planted(turned)
    assert result.accepted.tolist() == [True, True, True, False, False, True]
    off, turn = result.explain(3), result.explain(4)
    assert off.worst_conflict.translation == pytest.approx(5.0)
    assert off.worst_conflict.rotation == pytest.approx(0.0, abs=1e-6)
    assert turn.worst_conflict.rotation == pytest.approx(30.0)
    names = ("b", "a") if turned else ("a", "b")
    assert off.sentence.startswith(
        f"Closure 3 ({names[0]}20 to {names[1]}20) was rejected: it agrees with 0 of the 4 "
        "accepted ones; worst with closure "
    )
    assert " misses by 5 m (sigma " in off.sentence
    # exactly right but for itself, so what is left in the merged map is its mistake
    residual = off.fit.by_axis
    assert np.hypot(residual["x"], residual["y"]) == pytest.approx(5.0, rel=1e-6)
    assert abs(turn.fit.by_axis["theta"]) == pytest.approx(np.pi / 6, rel=1e-6)
    assert off.fit.chi2 == pytest.approx(400 * 25.0, rel=1e-6)
    assert off.fit.p < 1e-100


def test_shares_follow_the_closures_own_ends():
    """The same closure told from b to a: its a is now the other map."""
    one, two = (planted(turned).explain(3).worst_conflict for turned in (False, True))
    assert two.index == one.index
    assert two.shares == pytest.approx((one.shares[1], one.shares[0], one.shares[2]))


@both_groups
def test_costs_of_the_merge_add_up(group):
    """Twice the cost is the χ² of all edges and of the closures used."""
    _, result = evidence_and_result(group)
    edges = sum(edge.fit.chi2 for edge in result.strained_edges(10**6))
    closures = sum(one.fit.chi2 for one in explain(result) if one.accepted)
    assert edges + closures == pytest.approx(2.0 * result.solution.cost, rel=1e-9)


def test_the_most_strained_edge_is_the_false_one():
    _, result = evidence_and_result("SE2")
    maps = list(evidence_and_result("SE2")[0].graph.maps)
    one = maps[1]
    measured = np.array(lie.parameters(lie.as_numpy(one.measurement)))
    false = 30  # softer than all others, so of one force it gives way most
    measured[false, 2] += 3.0
    information = np.array(one.information)
    information[false] /= 100.0
    maps[1] = dataclasses.replace(one, measurement=one.group(measured), information=information)
    wrong = MultiRobotGraph(tuple(maps), result.candidates)
    merged = merge(wrong, accepted=result.accepted)
    first, second = merged.strained_edges(2)
    ends = one.pose_name(int(one.tail[false])), one.pose_name(int(one.head[false]))
    assert (first.robot, first.tail, first.head) == (one.name, *ends)
    assert first.odometry
    assert first.fit.chi2 > second.fit.chi2
    assert repr(first).count("\n") == 2
    with pytest.raises(InputError, match="count: -1, expected at least 0"):
        merged.strained_edges(-1)


def test_given_closures_are_said_to_be_given():
    evidence, result = evidence_and_result("SE2")
    given = merge(evidence, accepted=result.accepted)
    kept, left = int(np.argmax(result.accepted)), int(np.argmin(result.accepted))
    assert "was accepted because it was given as accepted; it was not weighed" in (
        given.explain(kept).sentence
    )
    told = given.explain(left)
    assert "was left out because it is not among those given" in told.sentence
    assert (told.standing, told.agrees_with, told.worst_conflict) == ("not weighed", None, None)
    assert told.fit.chi2 > 100.0
    assert repr(told).count("\n") == 2
    everything = merge(refused().selection.evidence, method="all")
    assert "because every closure was" in everything.explain(0).sentence


def test_robust_methods_tell_their_scales():
    evidence, result = evidence_and_result("SE2")
    robust = merge(evidence.optimized, optimized=True, method="gnc", initial="closures")
    for index in range(len(result.candidates)):
        share = robust.robust.scale[index] ** 2
        sentence = robust.explain(index).sentence
        if robust.accepted[index]:
            assert f"was kept by gnc with {100 * share:.0f} % of its information" in sentence
        elif not robust.robust.accepted[index]:
            assert "was rejected: gnc turned it down to 0 % of its information" in sentence
    assert robust.accepted.any() and not robust.robust.accepted.all()


@pytest.mark.slow
def test_a_metric_of_ones_own():
    """Its distances count what agrees; what the loop misses by is still in metres."""
    evidence, result = evidence_and_result("SE2")

    def metric(map_a, map_b, closures):
        return np.asarray(squared_mahalanobis(consistency_problem(map_a, map_b, closures)))

    own = merge(evidence.optimized, optimized=True, metric=metric, confidence=0.9)
    assert [one.sentence for one in explain(own)] == [one.sentence for one in explain(result)]


@functools.cache
def refused():
    world = simulate_city(seed=1, poses=80, inliers=3, aliased_groups=0, random=0)
    return merge(world.graph)


def test_a_set_that_was_refused():
    """Three closures agree, which is too few for chance: each says so."""
    result = refused()
    told = explain(result)
    assert [one.standing for one in told] == ["pair refused by chance"] * 3
    for one in told:
        assert (one.agrees_with, one.of, one.among) == (2, 2, "found")
        assert one.fit is None
        assert (
            "was rejected with all that were found between a and b, which were refused: 3 of 3"
            in (one.sentence)
        )
    few = merge(result.selection.evidence, minimum_inliers=9)
    assert {one.standing for one in explain(few)} == {"pair refused by number"}


def test_an_ambiguous_pair_names_both_sets():
    world = simulate_city(seed=1, poses=80, inliers=10, random=20)
    result = merge(world.graph)
    assert result.ambiguous
    standings = [one.standing for one in explain(result)]
    (pair,) = result.selection.pairs
    assert standings.count("pair refused as ambiguous") == pair.found
    assert standings.count("in the rival set") == pair.verdict.rival.size
    rival = explain(result)[standings.index("in the rival set")]
    assert f"it is one of {pair.verdict.rival.size} that agree on another alignment" in (
        rival.sentence
    )
    assert rival.sentence.endswith("; nothing between a and b is believed.")


@both_groups
def test_the_report_has_what_explanations_have(group):
    _, result = evidence_and_result(group)
    rows = result.report()["closures"]
    for row, one in zip(rows, explain(result), strict=True):
        assert row.items() >= one.as_dict().items()
        assert row["why"] == one.sentence
        assert row["worst_conflict"]["with"] == one.worst_conflict.index
        assert "\n" not in row["why"]


def test_numbers_can_be_read():
    given = (12.345, 0.8123, 40.04, 123.6, 12345.6, 0.00012, 0.0, float("nan"))
    told = ["12.3", "0.812", "40", "124", "12346", "0.00012", "0", "unknown"]
    assert [number(value) for value in given] == told
    assert (number(0.8123, 2), number(2.04, 2), number(11.6, 2)) == ("0.81", "2", "12")


def test_a_confidence_has_as_many_nines_as_it_needs():
    for value, told in ((0.9, "0.9"), (0.9938, "0.9938"), (0.99991, "0.99991")):
        assert confidence(value) == told
    for value in (0.72139, 0.980894, 0.99123456, 1.0 - 3.3e-8):
        assert 0.0 <= float(confidence(value)) - value <= 0.1 * (1.0 - value)


@pytest.mark.parametrize(
    ("agrees", "of", "words"),
    [
        (1, 1, "was accepted: it agrees with the other accepted one; worst"),
        (2, 2, "was accepted: it agrees with both other accepted ones; worst with closure 7"),
        (3, 3, "was accepted: it agrees with all 3 other accepted ones; worst with"),
        (2, 3, "was accepted, though it agrees with 2 of the 3 other accepted ones; worst"),
    ],
)
def test_how_many_others_a_closure_agrees_with(agrees, of, words):
    worst = SimpleNamespace(index=7, translation=np.nan)
    told = SimpleNamespace(worst_conflict=worst, agrees_with=agrees, of=of, fit=None)
    assert _accepted(told).startswith(words)


@pytest.mark.parametrize(("odometry", "kind"), [(True, "odometry"), (False, "loop")])
def test_a_strained_edge_in_words(odometry, kind):
    fit = Fit(9.25, (0.5, -1.0, 0.125), 0.026, 3)
    assert repr(StrainedEdge("a", "a3", "a4", "", odometry, fit)) == (
        f"StrainedEdge(a3 to a4, {kind} of robot a)\n"
        "  chi2      9.25, 3 expected\n"
        "  residual  x 0.5, y -1, theta 0.125 (m, rad)"
    )
