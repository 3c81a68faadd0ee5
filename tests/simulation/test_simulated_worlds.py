"""The city and the 3D sessions: truth, noise, and what makes closures consistent or not."""

import itertools

import jax
import jaxlie
import numpy as np
import pytest
from scipy import stats

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.simulation import simulate_city, simulate_sessions

WORLDS = {
    "city": lambda **more: simulate_city(**{"seed": 1, "poses": 600, **more}),
    "sessions": lambda **more: simulate_sessions(**{"seed": 1, "poses": 500, **more}),
}


@pytest.fixture(scope="module", params=WORLDS)
def world(request):
    return WORLDS[request.param](inliers=40, aliased_groups=3, aliased_size=8, random=50)


def squared_errors(true, measured, information):
    error = lie.log(lie.between(true, measured))
    return np.einsum("ni,nij,nj->n", error, np.asarray(information), error)


def ends(world, rows):
    """Measurements of some closures, and the true poses at both of their ends."""
    closures = world.graph.closures[rows]
    poses = [
        lie.stack(
            [
                lie.take(world.truth[robot], pose)
                for robot, pose in zip(
                    np.asarray(getattr(closures, f"robot_{end}")),
                    np.asarray(getattr(closures, f"pose_{end}")),
                    strict=True,
                )
            ]
        )
        for end in "ab"
    ]
    return lie.as_numpy(closures.measurement), *poses


def alignments(world, rows):
    """Where each closure puts map b, seen in the common frame: the identity for true ones."""
    measured, at_a, at_b = ends(world, rows)
    return lie.compose(lie.compose(at_a, measured), lie.inverse(at_b))


def pairwise_squared(world, rows):
    """Squared distances between closures when the maps are known exactly (map covariance 0).

    q² = rᵀ (Z_u + Z_v)⁻¹ r with r = Log(T_v T_u⁻¹) and Z = Ad(P_a z) Σ Ad(P_a z)ᵀ.
    """
    measured, at_a, _ = ends(world, rows)
    placed = alignments(world, rows)
    adjoint = lie.adjoint(lie.compose(at_a, measured))
    covariance = np.linalg.inv(np.asarray(world.graph.closures[rows].information))
    spread = adjoint @ covariance @ np.swapaxes(adjoint, 1, 2)
    u, v = np.array(list(itertools.combinations(range(len(spread)), 2))).T
    r = lie.log(lie.compose(lie.take(placed, v), lie.inverse(lie.take(placed, u))))
    return np.einsum("ni,nij,nj->n", r, np.linalg.inv(spread[u] + spread[v]), r)


def test_maps_have_the_odometry_chain_first_and_start_at_the_identity(world):
    for graph, truth in zip(world.graph.maps, world.truth, strict=True):
        n, group = graph.num_poses, graph.group
        assert np.array_equal(np.asarray(graph.tail)[: n - 1], np.arange(n - 1))
        assert np.array_equal(np.asarray(graph.head)[: n - 1], np.arange(1, n))
        assert graph.num_edges > n - 1
        assert len(lie.parameters(truth)) == n
        poses = lie.as_numpy(graph.poses)
        assert np.abs(lie.log(lie.take(poses, 0))).max() == 0.0
        # Raw odometry: consecutive poses repeat the first measurements, whatever the loops say.
        steps = lie.between(lie.take(poses, np.s_[:-1]), lie.take(poses, np.s_[1:]))
        chained = lie.log(
            lie.between(steps, lie.take(lie.as_numpy(graph.measurement), np.s_[: n - 1]))
        )
        assert np.abs(chained).max() < 1e-9
        assert group is world.graph.closures.group


def test_every_map_edge_is_as_good_as_its_information_says(world):
    for graph, truth in zip(world.graph.maps, world.truth, strict=True):
        true = lie.between(
            lie.take(truth, np.asarray(graph.tail)), lie.take(truth, np.asarray(graph.head))
        )
        squared = squared_errors(true, lie.as_numpy(graph.measurement), graph.information)
        assert stats.kstest(squared, "chi2", (graph.tangent_dim,)).pvalue > 0.01


def test_closures_called_true_are_and_no_others(world):
    measured, at_a, at_b = ends(world, np.arange(len(world.labels)))
    squared = squared_errors(lie.between(at_a, at_b), measured, world.graph.closures.information)
    d = world.graph.tangent_dim
    assert stats.kstest(squared[world.is_true], "chi2", (d,)).pvalue > 0.01
    assert squared[~world.is_true].min() > stats.chi2.ppf(1 - 1e-6, d)


def test_true_closures_lie_within_reach(world):
    _, at_a, at_b = ends(world, world.is_true)
    between = lie.log(lie.between(at_a, at_b))
    space = 2 if world.graph.tangent_dim == 3 else 3
    apart = np.linalg.norm(
        lie.parameters(at_a)[:, -space:] - lie.parameters(at_b)[:, -space:], axis=1
    )
    assert apart.max() <= 3.0
    assert len(np.unique(between.round(6), axis=0)) > 20


def test_labels_count_what_was_asked_for_in_shuffled_order(world):
    assert np.array_equal(world.is_true, world.labels == 0)
    values, counts = np.unique(world.labels, return_counts=True)
    assert values.tolist() == [-1, 0, 1, 2, 3]
    assert counts.tolist() == [50, 40, 8, 8, 8]
    assert np.count_nonzero(np.diff(world.labels)) > 50


@pytest.mark.parametrize("label", [0, 1, 2, 3])
def test_groups_are_consistent_with_themselves_by_their_own_noise(world, label):
    rows = world.labels == label
    d, count = world.graph.tangent_dim, rows.sum()
    squared = pairwise_squared(world, rows)
    # Pairs of one group share measurements: only the mean of all is tested, against the
    # standard error of `count` independent ones.
    assert abs(squared.mean() - d) < 4.0 * np.sqrt(2.0 * d / count)
    assert np.mean(squared > stats.chi2.ppf(0.99, d)) < 0.15


def test_different_groups_and_random_closures_contradict_each_other(world):
    d = world.graph.tangent_dim
    one_of_each = [np.flatnonzero(world.labels == label)[0] for label in (0, 1, 2, 3)]
    assert pairwise_squared(world, np.array(one_of_each)).min() > 100.0 * d
    loners = pairwise_squared(world, np.flatnonzero(world.labels == -1)[:30])
    assert np.mean(loners > stats.chi2.ppf(0.99, d)) > 0.99


def test_no_two_groups_share_an_alignment_even_in_a_small_town():
    town = simulate_city(seed=0, poses=60, inliers=0, aliased_groups=40, aliased_size=1, random=0)
    squared = pairwise_squared(town, np.arange(40))
    assert squared.min() > stats.chi2.ppf(0.99, 3)  # on the bare grid of streets, 8 pairs coincide


def test_aliased_closures_claim_plausible_ranges_for_places_far_apart(world):
    space = 2 if world.graph.tangent_dim == 3 else 3
    for label in (1, 2, 3):
        measured, at_a, at_b = ends(world, world.labels == label)
        claimed = np.linalg.norm(lie.parameters(measured)[:, -space:], axis=1)
        apart = np.linalg.norm(
            lie.parameters(at_a)[:, -space:] - lie.parameters(at_b)[:, -space:], axis=1
        )
        assert np.median(claimed) < 4.0
        assert np.median(apart) > 5.0


def test_random_closures_cover_the_map_and_all_headings():
    world = simulate_city(seed=3, poses=400, inliers=0, aliased_groups=0, random=2_000)
    measured, at_a, _ = ends(world, world.labels == -1)
    claimed = lie.parameters(lie.compose(at_a, measured))
    places = np.concatenate([lie.parameters(truth)[:, 2:] for truth in world.truth])
    for axis in (0, 1):
        low, high = places[:, axis].min(), places[:, axis].max()
        law = stats.uniform(low, high - low)
        assert stats.kstest(claimed[:, 2 + axis], law.cdf).pvalue > 0.01
    heading = lie.log(measured)[:, 2]
    assert stats.kstest(heading, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 0.01


@pytest.mark.parametrize("make", WORLDS)
def test_random_closures_within_a_range_fill_the_ball_evenly(make):
    world = WORLDS[make](inliers=0, aliased_groups=0, random=2_000, random_range=4.0)
    measured, _, _ = ends(world, world.labels == -1)
    space = 2 if make == "city" else 3
    radius = np.linalg.norm(lie.parameters(measured)[:, -space:], axis=1)
    assert stats.kstest((radius / 4.0) ** space, "uniform").pvalue > 0.01
    rotation = lie.parameters(measured)[:, :-space]
    assert np.abs(rotation.mean(axis=0)).max() < 0.08


@pytest.mark.parametrize("make", WORLDS)
def test_the_seed_decides_everything(make):
    first, again, other = (WORLDS[make](seed=seed) for seed in (7, 7, 8))
    leaves = [jax.tree.leaves((w.graph, w.truth)) for w in (first, again, other)]
    assert all(np.array_equal(a, b) for a, b in zip(leaves[0], leaves[1], strict=True))
    assert np.array_equal(first.labels, again.labels)
    assert not np.array_equal(first.labels, other.labels)


def test_the_city_is_like_city10000():
    world = simulate_city(seed=0, poses=10_000, robots=1)
    graph, truth = world.graph.maps[0], lie.parameters(world.truth[0])
    steps = lie.log(
        lie.between(lie.take(world.truth[0], np.s_[:-1]), lie.take(world.truth[0], np.s_[1:]))
    )
    assert np.allclose(np.linalg.norm(np.diff(truth[:, 2:], axis=0), axis=1), 1.0)
    turning = np.abs(steps[:, 2]) > 0.1
    assert np.allclose(np.abs(steps[turning, 2]), np.pi / 2)
    assert 0.03 < turning.mean() < 0.06  # City10000: 0.045
    assert np.ptp(truth[:, 2:], axis=0).tolist() == [100.0, 100.0]  # City10000: 105 m
    loops = graph.num_edges - (graph.num_poses - 1)
    assert 0.9 < loops / graph.num_poses < 1.4  # City10000: 1.07
    assert len(world.labels) == 0


def test_sessions_stand_upright_on_one_rolling_ground():
    world = simulate_sessions(seed=2, poses=400)
    for truth in world.truth:
        matrix = lie.as_matrix(truth)
        places, step = matrix[:, :3, 3], np.diff(matrix[:, :3, 3], axis=0)
        length = np.linalg.norm(step[:, :2], axis=1)
        assert np.abs(length - 2.0).max() < 0.1
        assert matrix[:, 2, 2].min() > 0.9  # z axes point up
        assert np.ptp(places[:, 2]) > 1.0
        ahead = np.einsum("ni,ni->n", matrix[:-1, :3, 0], step / length[:, None])
        assert np.median(ahead) > 0.999
        # The ground is tangent: no step leaves the plane that its pose stands on by much.
        climb = np.einsum("ni,ni->n", matrix[:-1, :3, 2], step)
        assert np.abs(climb).max() < 0.1
    assert np.abs(lie.log(world.truth[0])[:, 3:5]).max() > 0.02  # there is roll and pitch


def test_many_robots_get_candidates_for_every_pair():
    world = simulate_city(seed=4, poses=500, robots=4, inliers=6, random=10)
    assert world.graph.names == ("a", "b", "c", "d")
    pairs = list(itertools.combinations(range(4), 2))
    assert world.graph.closures.pairs() == pairs
    assert (world.labels == 0).sum() == 6 * len(pairs)
    aliased, counts = np.unique(world.labels[world.labels > 0], return_counts=True)
    assert aliased.tolist() == list(range(1, 13))
    assert (counts == 5).all()
    for label in aliased:  # a group belongs to one pair of robots
        closures = world.graph.closures[world.labels == label]
        assert len(closures.pairs()) == 1


def test_information_is_the_inverse_of_the_noise_asked_for():
    world = simulate_city(seed=0, poses=200, sigma_translation=0.5, sigma_rotation=0.1)
    expected = np.diag([4.0, 4.0, 100.0])
    for information in (world.graph.maps[1].information, world.graph.closures.information):
        assert np.allclose(information, expected)
    drift = simulate_city(seed=0, poses=200).graph.maps[0]
    assert np.allclose(drift.information, np.diag([2500.0, 2500.0, 10_000.0]))


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"poses": 1}, "poses"),
        ({"robots": 0}, "robots"),
        ({"robots": 27}, "robots"),
        ({"inliers": -1}, "inliers"),
        ({"random": -2}, "random"),
        ({"sigma_rotation": 0.0}, "sigma_rotation"),
        ({"aliased_size": 10_000}, "aliased_size"),
        ({"poses": 20, "inliers": 10_000}, "inliers"),
    ],
)
def test_impossible_cities_are_refused_by_name(wrong, name):
    with pytest.raises(InputError, match=name):
        simulate_city(**wrong)


def test_a_session_without_noise_is_refused():
    with pytest.raises(InputError, match="closure_sigma_rotation"):
        simulate_sessions(closure_sigma_rotation=-1.0)


def test_worlds_are_float64_jaxlie_containers(world):
    for graph in world.graph.maps:
        assert isinstance(graph.poses, jaxlie.SE2 | jaxlie.SE3)
        assert lie.parameters(graph.poses).dtype == np.float64
    assert all(isinstance(lie.parameters(truth), np.ndarray) for truth in world.truth)
