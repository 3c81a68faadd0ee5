"""The merged map's derivatives: against differences, in both modes, under every transformation.

Programs that hold a merge and its derivatives take long to compile, so tests share them, and those
that are compared with nothing else of their own kind are compiled without optimisation.
"""

import dataclasses
import gc
import weakref

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph, pad_graph, split
from pcm_jax.mapping import optimize
from pcm_jax.merging import merge_differentiable
from pcm_jax.pipeline import merge
from pcm_jax.sparse import registry
from pcm_jax.sparse.system import System

pytestmark = pytest.mark.slow


def noisy(rng, exact, sigma):
    """Measurements of exact relative poses, and the covariance of their noise."""
    d = lie.tangent_dim(exact)
    count = len(lie.parameters(exact))
    root = sigma * (np.eye(d) + 0.3 * rng.normal(size=(count, d, d)))
    error = np.einsum("eij,ej->ei", root, rng.normal(size=(count, d)))
    moved = lie.compose(exact, lie.exp(lie.group_of(exact), error))
    return {"measurement": moved, "covariance": root @ root.swapaxes(1, 2)}


def small_world(group, seed=0, robots=2, poses=8, rows=((0, 1), (0, 1), (1, 0), (0, 1), (1, 0))):
    """Maps with loops in frames of their own, and closures between the robots of `rows`.

    Noise is large, so that the Hessian is not the normal equations' matrix.
    """
    rng = np.random.default_rng(seed)
    d = lie.tangent_dim(group)
    maps, truth = [], []
    for _ in range(robots):
        placed = lie.exp(group, rng.normal(size=(poses, d)))
        tail = np.array([*range(poses - 1), 0, 2, 1])
        head = np.array([*range(1, poses), poses - 1, 5, 6])
        edges = noisy(rng, lie.between(lie.take(placed, tail), lie.take(placed, head)), 0.1)
        frame = lie.exp(group, 3.0 * rng.normal(size=d))
        own = lie.compose(frame, placed)
        maps.append(PoseGraph.from_arrays(poses=own, tail=tail, head=head, **edges))
        truth.append(placed)
    a, b = np.array(rows).T
    i, k = rng.integers(poses, size=(2, len(rows)))
    ends = [
        lie.stack([lie.take(truth[r], p) for r, p in zip(*e, strict=True)])
        for e in ((a, i), (b, k))
    ]
    measured = noisy(rng, lie.between(*ends), 0.15)
    closures = LoopClosures.from_arrays(robot_a=a, pose_a=i, robot_b=b, pose_b=k, **measured)
    return MultiRobotGraph(tuple(maps), closures)


def moved_graph(graph, theta):
    """Closures moved on the right, their information and the first map's edges and frame moved."""
    closures, first = graph.closures, graph.maps[0]
    step = lie.exp(graph.group, theta["closure"])
    edge = lie.exp(graph.group, theta["edge"])
    symmetric = theta["information"] + jnp.swapaxes(theta["information"], 1, 2)
    closures = dataclasses.replace(
        closures,
        measurement=lie.compose(closures.measurement, step),
        information=closures.information + symmetric,
    )
    first = dataclasses.replace(
        first,
        poses=lie.compose(lie.exp(graph.group, theta["frame"]), first.poses),
        measurement=lie.compose(first.measurement, edge),
    )
    return MultiRobotGraph((first, *graph.maps[1:]), closures)


INPUTS = ("closure", "edge", "information", "weight", "frame")


def still(graph):
    m, d = len(graph.closures), graph.tangent_dim
    edges = graph.maps[0].num_edges
    shapes = ((m, d), (edges, d), (m, d, d), (m,), (d,))
    return {name: jnp.zeros(shape) for name, shape in zip(INPUTS, shapes, strict=True)}


def loss_of(graph, seed=1, poses=8):
    """A function of the first poses, every parameter of them, and of `still`'s perturbations."""
    rng = np.random.default_rng(seed)
    width = lie.parameters(graph.maps[0].poses).shape[1]
    pulls = [jnp.asarray(rng.normal(size=(poses, width))) for _ in graph.maps]

    def loss(theta):
        merged = merge_differentiable(moved_graph(graph, theta), theta["weight"])
        values = [lie.parameters(each)[:poses] for each in merged]
        return sum(jnp.vdot(c, x) for c, x in zip(pulls, values, strict=True)), values

    return loss


def both_modes(loss):
    """One program: value, derivative along `direction`, gradient, and the poses."""

    @compiled_fast
    def run(theta, direction):
        value, forward, poses = jax.linearize(loss, theta, has_aux=True)
        (gradient,) = jax.linear_transpose(forward, theta)(jnp.ones(()))
        return value, forward(direction), gradient, poses

    return run


QUICK: dict = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": True}
"""As the suite compiles, but by the usual emitters: without them padding moves the last bit."""


def compiled_fast(function):
    """`jax.jit` with the least work of LLVM's, which is most of a compilation."""
    return jax.jit(function, compiler_options=QUICK)


WEIGHTS = jnp.asarray([1.0, 0.4, 0.7, 0.0, 0.9])


@pytest.fixture(scope="module", params=["SE2", "SE3"])
def case(request):
    """A graph and its loss in both modes; `WEIGHTS` have one closure switched off."""
    if request.param == "SE2":
        return request.getfixturevalue("three"), request.getfixturevalue("run_three")
    graph = small_world(jaxlie.SE3)
    return graph, both_modes(loss_of(graph))


def weighted(graph, weights):
    return still(graph) | {"weight": jnp.asarray(weights)}


def moved(at, direction, by):
    return jax.tree.map(lambda leaf, along: leaf + by * along, at, direction)


def direction_in(graph, weights, name, seed=2):
    """A random direction in one input, of the size at which differences are taken."""
    leaf = still(graph)[name]
    along = np.random.default_rng(seed).normal(size=leaf.shape)
    if name == "weight":
        along *= np.asarray(weights) > 0.0
    if name == "information":
        along *= 0.03 * float(np.abs(graph.closures.information).max())
    return still(graph) | {name: jnp.asarray(along)}


@pytest.mark.parametrize("name", INPUTS)
def test_derivatives_are_those_of_differences(case, name):
    graph, run = case
    at, direction = weighted(graph, WEIGHTS), direction_in(graph, WEIGHTS, name)
    _, forward, gradient, _ = run(at, direction)
    reverse = float(jnp.vdot(gradient[name], direction[name]))

    def slope(h):
        ahead, behind = (run(moved(at, direction, by), at)[0] for by in (h, -h))
        return float(ahead - behind) / (2 * h)

    h = 5e-3
    assert abs(reverse) > 1e-3
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)
    np.testing.assert_allclose(reverse, (4.0 * slope(h / 2) - slope(h)) / 3.0, rtol=1e-6)


def test_slope_at_weight_zero(case):
    """From above: what switching closure 3 on would do."""
    graph, run = case
    at, unit = weighted(graph, WEIGHTS), weighted(graph, jnp.zeros(5).at[3].set(1.0))
    h = 3e-4
    values = [float(run(moved(at, unit, k * h), at)[0]) for k in range(5)]
    one_sided = np.dot([-25.0, 48.0, -36.0, 16.0, -3.0], values) / (12.0 * h)
    slope = run(at, at)[2]["weight"][3]
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, one_sided, rtol=1e-6)


# What the poses are


def parameters_of(merged):
    return [np.asarray(lie.parameters(poses)) for poses in merged]


ROWS = ((2, 0), (0, 2), (0, 1), (1, 2), (1, 0))


@pytest.fixture(scope="module")
def three():
    """Robots 0 and 2 joined by two closures, robot 1 to both by others."""
    graph = small_world(jaxlie.SE2, seed=3, robots=3, rows=ROWS)
    return MultiRobotGraph(tuple(optimize(own).graph for own in graph.maps), graph.closures)


@pytest.fixture(scope="module")
def run_three(three):
    """Both modes for it."""
    return both_modes(loss_of(three))


@pytest.mark.parametrize("off", [(), (3,), (2, 3, 4), (0, 1, 2, 3, 4)])
def test_weights_of_zero_and_one_are_a_merge(three, off):
    """All three together, by fewer closures, robot 1 alone, all alone."""
    inliers = np.ones(5, bool)
    inliers[list(off)] = False
    expected = merge(three, accepted=inliers, optimized=True)
    found = merge_differentiable(three, inliers)
    for own, merged in zip(found, expected.graph.maps, strict=True):
        np.testing.assert_allclose(lie.as_matrix(own), lie.as_matrix(merged.poses), atol=1e-6)


def test_between_groups_the_slope_is_zero(three, run_three):
    at = weighted(three, [1.0, 1.0, 0.0, 0.0, 0.0])
    _, _, gradient, _ = run_three(at, at)
    assert np.abs(gradient["weight"][:2]).min() > 1e-3
    np.testing.assert_array_equal(gradient["weight"][2:], 0.0)
    np.testing.assert_array_equal(gradient["closure"][2:], 0.0)


def test_the_groups_first_pose_stays(three):
    first = three.maps[0].poses
    merged = merge_differentiable(three, jnp.ones(5))
    np.testing.assert_allclose(parameters_of(merged)[0][0], lie.parameters(first)[0], atol=1e-12)


# Transformations


@pytest.fixture(scope="module")
def batch(three):
    """Four padded worlds, the second of another structure and size, and their masked losses."""
    other = small_world(jaxlie.SE2, 7, robots=3, poses=9, rows=ROWS[1:])
    sizes = {"poses": 9, "edges": 11, "closures": 5}
    padded = [pad_graph(world, **sizes) for world in (three, other, three, three)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)

    def masked_loss(graph, weights, information):
        closures = dataclasses.replace(graph.closures, information=information)
        merged = merge_differentiable(MultiRobotGraph(graph.maps, closures), weights)
        values = [lie.parameters(poses) for poses in merged]
        total = jnp.sum(values[1] ** 2)
        return jnp.where(jnp.isfinite(total), total, 0.0), values

    run = jax.vmap(jax.value_and_grad(masked_loss, argnums=(1, 2), has_aux=True))
    return stacked, compiled_fast(run), other


def test_one_bad_sample_in_a_batch(three, batch):
    """Numbers of the others stay the same bit for bit; nothing flows back from the bad ones."""
    worlds, run, _ = batch
    weights = np.random.default_rng(4).uniform(0.2, 1.0, (4, 5))
    information = np.array(worlds.closures.information)
    (_, expected), wanted = run(worlds, weights, information)
    weights[2, 1] = np.nan
    information[1, 0] = -np.eye(3)
    (losses, found), gradients = run(worlds, weights, information)
    good, bad = np.array([0, 3]), np.array([1, 2])
    for values, right in zip(found, expected, strict=True):
        np.testing.assert_array_equal(values[good], right[good])
        assert np.isnan(values[bad]).all()
    np.testing.assert_array_equal(losses[bad], 0.0)
    for gradient, want in zip(gradients, wanted, strict=True):
        np.testing.assert_array_equal(gradient[bad], 0.0)
        np.testing.assert_array_equal(gradient[good], want[good])
        assert np.abs(want).max() > 1e-6
    alone = parameters_of(merge_differentiable(three, weights[0]))[1]
    np.testing.assert_allclose(found[1][0, : len(alone)], alone, rtol=0, atol=1e-12)


def test_structure_may_differ_within_a_batch(three, batch):
    """Other ends, and another size: each gives what it gives alone."""
    worlds, run, other = batch
    (_, merged), _ = run(worlds, np.ones((4, 5)), worlds.closures.information)
    for row, world in enumerate((three, other)):
        for found, own in zip(merged, merge_differentiable(world, np.ones(5 - row)), strict=True):
            values, kept = lie.parameters(own), world.maps[0].num_poses
            np.testing.assert_allclose(found[row, :kept], values, atol=1e-11)


def test_more_structures_than_are_kept(monkeypatch):
    """A hundred and ten in a batch, each with a closure elsewhere, and a cache of a hundred."""
    monkeypatch.setattr(registry.systems, "_size", 100)
    side, count = 11, 110
    pose = np.arange(side)
    line = lie.exp(jaxlie.SE2, pose[:, None] * np.array([1.0, 0.0, 0.0]))
    edges = {"sigma_translation": 0.1, "sigma_rotation": 0.01}
    maps = tuple(PoseGraph.from_trajectory(line, **edges) for _ in range(2))
    pose_a, pose_b = (ends.ravel()[:count, None] for ends in np.meshgrid(pose, pose))
    measured = lie.between(lie.take(line, pose_a), lie.take(line, pose_b))

    def merged(pose_a, pose_b, values):
        information = jnp.eye(3)[None]
        ends = {"robot_a": jnp.zeros(1, int), "robot_b": jnp.ones(1, int)}
        ends |= {"pose_a": pose_a, "pose_b": pose_b}
        closures = LoopClosures(**ends, measurement=jaxlie.SE2(values), information=information)
        return lie.parameters(merge_differentiable(MultiRobotGraph(maps, closures), jnp.ones(1))[1])

    run = compiled_fast(jax.vmap(merged))
    found = run(pose_a.astype(np.int32), pose_b.astype(np.int32), lie.parameters(measured))
    expected = np.broadcast_to(lie.parameters(line), (count, side, 4))
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_no_factor_is_left_behind(three, monkeypatch):
    left, factorize = [], System.factorize

    def watched(self, *arguments):
        factor = factorize(self, *arguments)
        left.append(weakref.ref(factor))
        return factor

    monkeypatch.setattr(System, "factorize", watched)
    for weights in (np.ones(5), WEIGHTS):
        jax.block_until_ready(merge_differentiable(three, weights))
    gc.collect()
    assert len(left) > 4
    assert not any(factor() for factor in left)
    assert registry.spare.nbytes == 0


def test_padding_changes_nothing(three, run_three):
    """Poses, edges and closures added to every map, bit for bit, derivatives included."""
    weights = np.array([1.0, 0.5, 0.0, 0.8, 0.3])
    longer = pad_graph(three, poses=13, edges=17, closures=7)
    measurement = np.array(lie.parameters(longer.closures.measurement))
    measurement[5:] = np.nan
    odd = dataclasses.replace(longer.closures, measurement=jaxlie.SE2(jnp.asarray(measurement)))
    longer = MultiRobotGraph(longer.maps, odd)
    at = weighted(three, weights)
    _, _, wanted, expected = run_three(at, at)
    more = weighted(longer, np.append(weights, [0.7, np.nan]))
    _, _, gradient, found = both_modes(loss_of(longer))(more, jax.tree.map(jnp.zeros_like, more))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(gradient["weight"][:5], wanted["weight"])
    np.testing.assert_array_equal(gradient["weight"][5:], 0.0)
    assert np.abs(wanted["weight"]).max() > 1e-3


def test_second_derivatives(three, run_three):
    """The rule is differentiable itself."""
    weights, along = np.array([1.0, 0.5, 0.4, 0.8, 0.3]), np.array([0.3, -0.1, 0.2, 0.1, 0.4])
    loss = loss_of(three)

    def on_the_line(t):
        return loss(weighted(three, weights + t * along))[0]

    slope = lambda t: jax.jvp(on_the_line, (t,), (jnp.ones(()),))[1]  # noqa: E731
    _, bend = compiled_fast(lambda t: jax.jvp(slope, (t,), (jnp.ones(()),)))(jnp.zeros(()))
    h, unit = 1e-3, weighted(three, along)
    ahead, behind = (run_three(weighted(three, weights + t * along), unit)[1] for t in (h, -h))
    assert abs(float(bend)) > 1e-3
    np.testing.assert_allclose(bend, (ahead - behind) / (2 * h), rtol=1e-5)


def test_city10000_in_a_few_solves(shared_data):
    """Real size: value and gradient by everything."""
    whole = read_graph(shared_data / "city10000" / "city10000.g2o.xz").maps[0]
    halves = split(whole, [whole.num_poses // 2])
    few = halves.closures[np.arange(0, len(halves.closures), 20)]
    graph = MultiRobotGraph(tuple(optimize(own).graph for own in halves.maps), few)
    weights = np.random.default_rng(0).uniform(0.3, 1.0, len(few))
    weights[::5] = 0.0
    run = both_modes(loss_of(graph, poses=halves.maps[0].num_poses))
    at, along = weighted(graph, weights), direction_in(graph, weights, "closure")
    _, forward, gradient, _ = run(at, along)
    np.testing.assert_allclose(forward, jnp.vdot(gradient["closure"], along["closure"]), rtol=1e-6)
    ahead, behind = (float(run(moved(at, along, h), at)[0]) for h in (1e-3, -1e-3))
    np.testing.assert_allclose(forward, (ahead - behind) / 2e-3, rtol=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_what_is_refused(three):
    with pytest.raises(InputError, match=r"weights: shape \(4,\), expected \(5,\)"):
        merge_differentiable(three, np.ones(4))
    with pytest.raises(InputError, match="solver: 'newton' given, expected one of gauss-newton"):
        merge_differentiable(three, np.ones(5), solver="newton")
