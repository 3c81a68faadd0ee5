"""`optimize`: the optimum, from every start, by every solver and engine."""

import dataclasses
import functools
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jaxlie
import lineax as lx
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.stats import chi2

from pcm_jax import lie
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping import optimize
from pcm_jax.mapping._linearization import linearize, retract, whitened_residual
from pcm_jax.mapping._normal_equations import (
    BlockCholesky,
    BlockJacobian,
    Cholmod,
    DampedJacobian,
)
from pcm_jax.mapping.least_squares import PoseProblem, padded_edges
from pcm_jax.mapping.optimization import (
    UNLIKELY,
    Solution,
    _is_suspicious,
    host_arrays,
    optimize_from,
)
from pcm_jax.sparse import registry
from pcm_jax.sparse.system import System

STARTS = ["chordal", "spanning-tree", "given"]
SOLVERS = ["gauss-newton", "levenberg-marquardt"]


@jax.jit
def slope_at(poses, edges, step):
    def cost(step):
        return 0.5 * jnp.sum(whitened_residual(retract(poses, step), edges) ** 2)

    return jax.grad(cost)(step)


def gradient(graph):
    zero = np.zeros((graph.num_poses, graph.tangent_dim))
    return np.asarray(slope_at(graph.poses, padded_edges(*host_arrays(graph), size=256), zero))


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("initial", STARTS)
def test_the_gradient_vanishes_at_the_optimum(group, make_map, initial, solver):
    graph = make_map(group, noise=0.05)
    solution = optimize(graph, initial=initial, solver=solver)
    assert solution.converged
    assert solution.cost <= solution.initial_cost
    slope = gradient(solution.graph)
    assert np.abs(slope[1:]).max() < 1e-5 * np.abs(gradient(graph)).max()
    first = [lie.parameters(lie.take(g.poses, 0)) for g in (graph, solution.graph)]
    np.testing.assert_allclose(first[1], first[0], atol=1e-14)


@pytest.mark.slow
def test_starts_solvers_and_engines_agree(group, make_map):
    pytest.importorskip("sparsax")
    graph = make_map(group, poses=60, loops=40, noise=0.05)
    costs = [
        optimize(graph, initial=initial, solver=solver, engine=engine).cost
        for initial in STARTS
        for solver in SOLVERS
        for engine in ("blocks", "cholmod")
    ]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-8)


def test_the_cost_is_recomputed_from_the_returned_poses(group, make_map):
    solution = optimize(make_map(group))
    edges = padded_edges(*host_arrays(solution.graph), size=256)
    again = 0.5 * float(jnp.sum(whitened_residual(solution.graph.poses, edges) ** 2))
    np.testing.assert_allclose(solution.cost, again, rtol=1e-10)


@pytest.mark.slow
def test_cost_follows_the_chi_squared_law(group, make_map):
    """2 cost ~ χ² with rows − columns degrees of freedom, over 60 worlds of matched noise."""
    from scipy.stats import chi2

    graphs = [make_map(group, seed=seed, noise=0.002) for seed in range(60)]
    freedom = sum((g.num_edges - g.num_poses + 1) * g.tangent_dim for g in graphs)
    total = 2.0 * sum(optimize(graph).cost for graph in graphs)
    assert 0.001 < chi2.cdf(total, freedom) < 0.999


def test_moving_the_whole_map_changes_nothing(group, make_map):
    graph = make_map(group, noise=0.05)
    far = lie.exp(group, 0.7 * np.ones(graph.tangent_dim))
    moved = graph.with_poses(lie.as_device(lie.compose(far, lie.as_numpy(graph.poses))))
    plain, other = optimize(graph), optimize(moved)
    np.testing.assert_allclose(other.cost, plain.cost, rtol=1e-9)
    expected = lie.compose(far, lie.as_numpy(plain.graph.poses))
    np.testing.assert_allclose(lie.as_matrix(other.graph.poses), lie.as_matrix(expected), atol=1e-7)


@pytest.mark.parametrize("offset", [1e5, 5.4e6])
def test_far_from_the_origin_rounding_is_no_reason_to_go_on(group, offset):
    """A chain in UTM's coordinates: its optimum costs nothing, and only rounding is left of it."""
    rng, d = np.random.default_rng(1), lie.tangent_dim(group)
    steps = rng.normal(scale=0.02, size=(19, d))
    steps[:, 0] += 1.0
    poses = [lie.identity(group)]
    for step in steps:
        poses.append(lie.compose(poses[-1], lie.exp(group, step)))
    values = np.array(lie.parameters(lie.stack(poses)))
    values[:, -2:] += offset
    chain = PoseGraph.from_arrays(
        poses=group(values),
        tail=np.arange(19),
        head=np.arange(1, 20),
        measurement=lie.exp(group, steps),
        covariance=np.tile(np.diag(np.full(d, 0.02**2)), (19, 1, 1)),
    )
    solution = optimize(chain)
    assert solution.converged
    assert solution.iterations <= 3


def test_repeated_edges_add_their_information(make_map):
    graph = make_map(noise=0.05)
    twice = PoseGraph.from_arrays(
        poses=graph.poses,
        tail=np.tile(graph.tail, 2),
        head=np.tile(graph.head, 2),
        measurement=lie.concatenate([lie.as_numpy(graph.measurement)] * 2),
        information=np.tile(graph.information, (2, 1, 1)),
    )
    np.testing.assert_allclose(optimize(twice).cost, 2.0 * optimize(graph).cost, rtol=1e-9)


def test_a_single_pose_is_its_own_optimum(group):
    graph = PoseGraph.from_arrays(
        poses=lie.identity(group, (1,)),
        tail=np.empty(0, int),
        head=np.empty(0, int),
        measurement=lie.identity(group, (0,)),
        information=np.empty((0, lie.tangent_dim(group), lie.tangent_dim(group))),
    )
    solution = optimize(graph)
    assert (solution.cost, solution.iterations, solution.converged) == (0.0, 0, True)


def test_giving_up_is_reported_not_raised(group, make_map):
    graph = make_map(group, noise=0.3)
    solution = optimize(graph, initial="given", solver="levenberg-marquardt", max_steps=4)
    assert not solution.converged
    assert solution.iterations <= 3
    assert solution.cost <= solution.initial_cost


def test_the_last_evaluation_is_not_followed_by_a_factorisation(make_map, monkeypatch):
    """Nobody would judge where its step leads."""
    factorised, factorize = [], System.factorize

    def counted(self, *arguments):
        factorised.append(True)
        return factorize(self, *arguments)

    monkeypatch.setattr(System, "factorize", counted)
    solution = optimize(make_map(noise=0.3), initial="given", max_steps=2)
    assert solution.iterations == 1
    assert len(factorised) == 1


def test_scaled_edges_are_edges_of_scaled_information(group, make_map):
    graph = make_map(group, noise=0.05)
    tail, head, measurement, information = host_arrays(graph)
    scale = np.random.default_rng(0).uniform(0.1, 2.0, len(tail))
    first, start = np.arange(graph.num_poses) == 0, lie.as_numpy(graph.poses)
    scaled = (scale**2)[:, None, None] * information
    expected = PoseProblem(tail, head, measurement, scaled, first).solve(start)
    problem = PoseProblem(tail, head, measurement, information, first)
    for _ in range(2):  # it is not used up
        found = problem.solve(start, scale=scale)
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9)
        poses = lie.parameters(found.poses), lie.parameters(expected.poses)
        np.testing.assert_allclose(*poses, atol=1e-7)
    assert problem.solve(start).cost != pytest.approx(expected.cost, rel=1e-3)


def test_names_are_checked(make_map):
    with pytest.raises(InputError, match="initial: 'tree' given, expected one of chordal"):
        optimize(make_map(), initial="tree")
    with pytest.raises(InputError, match="solver: 'newton' given, expected one of gauss-newton"):
        optimize(make_map(), solver="newton")
    with pytest.raises(InputError, match="engine: 'qr' given"):
        optimize(make_map(), engine="qr")


def test_the_former_name_of_the_solver(make_map):
    graph = make_map(noise=0.05)
    solver = "levenberg-marquardt"
    assert optimize(graph, method=solver).cost == optimize(graph, solver=solver).cost
    with pytest.raises(InputError, match=f"method: 'x' given, expected none beside .*'{solver}'"):
        optimize(graph, solver=solver, method="x")


def test_a_solution_is_readable(make_map):
    solution = optimize(make_map())
    first, cost, steps = repr(solution).splitlines()
    assert first == f"Solution of {solution.graph!r}"
    assert cost.strip() == f"cost {solution.cost:.6g}, from {solution.initial_cost:.6g}"
    assert steps.strip() == f"converged after {solution.iterations} steps"
    stopped = dataclasses.replace(solution, converged=False)
    assert repr(stopped).endswith(f"did not converge after {solution.iterations} steps")


@pytest.fixture
def jacobian(group, make_map):
    """The Jacobian of a map of 12 poses padded to 16, a residual, and which poses are free."""
    graph = make_map(group, poses=12, loops=6)
    edges = padded_edges(*host_arrays(graph), size=32)
    free = (np.arange(16) > 0) & (np.arange(16) < 12)
    poses = lie.pad_leading(lie.as_numpy(graph.poses), 16)
    residual, by_tail, by_head = linearize(poses, edges)
    counts = np.array([12, graph.num_edges])
    parts = edges.tail, edges.head, by_tail, by_head, free, counts
    return BlockJacobian(*map(jnp.asarray, parts)), jnp.asarray(residual), free


@pytest.mark.slow
@pytest.mark.parametrize("damping", [None, 0.0, 0.3])
def test_operators_are_what_their_products_say(jacobian, damping):
    """`mv`, `as_matrix`, `transpose` and the structures are of one matrix, damping included."""
    plain, _, free = jacobian
    operator = plain if damping is None else DampedJacobian(plain, jnp.asarray(damping))
    rng = np.random.default_rng(0)
    dense = np.asarray(operator.as_matrix())
    assert dense.shape == (operator.out_size(), operator.in_size())
    step = jnp.asarray(rng.normal(size=operator.in_structure().shape))
    image, unravel = ravel_pytree(operator.mv(step))
    scale = np.abs(dense).max()
    np.testing.assert_allclose(image, dense @ np.ravel(step), atol=1e-12 * scale)
    assert jax.tree.map(jnp.shape, operator.mv(step)) == jax.tree.map(
        lambda struct: struct.shape, operator.out_structure()
    )
    right = jnp.asarray(rng.normal(size=len(image)))
    found = np.ravel(operator.T.mv(unravel(right)))
    np.testing.assert_allclose(found, dense.T @ right, atol=1e-11 * scale)
    columns = dense.reshape(len(dense), *operator.in_structure().shape)
    assert not columns[:, ~free].any()
    if damping:
        undamped = np.asarray(plain.as_matrix())
        expected = undamped.T @ undamped
        expected += damping * np.diag(np.diag(expected))
        np.testing.assert_allclose(dense.T @ dense, expected, atol=1e-12 * scale**2)


@pytest.mark.parametrize("engine", [BlockCholesky, Cholmod])
@pytest.mark.parametrize("damping", [None, 0.3])
def test_engines_solve_the_dense_least_squares_problem(jacobian, damping, engine):
    """Any right side, also where Levenberg-Marquardt has zeros."""
    if engine is Cholmod:
        pytest.importorskip("sparsax")
    operator, right, free = jacobian
    if damping is not None:
        operator = DampedJacobian(operator, jnp.asarray(damping))
        below = np.random.default_rng(1).normal(size=operator.in_structure().shape)
        right = right, jnp.asarray(below)
    solved = lx.linear_solve(operator, right, engine())
    assert solved.result == lx.RESULTS.successful
    rows = np.repeat(free, operator.in_structure().shape[1])
    dense, vector = np.asarray(operator.as_matrix())[:, rows], ravel_pytree(right)[0]
    expected = np.linalg.lstsq(dense, vector, rcond=None)[0]
    found = np.ravel(solved.value)
    np.testing.assert_allclose(found[rows], expected, rtol=1e-8, atol=1e-12)
    assert not found[~rows].any()


def test_eight_threads_optimise_as_one_does(make_map):
    """Bit for bit, with every pattern made anew by whoever comes first."""
    graphs = [make_map(poses=40 + k % 4, loops=20, seed=k % 4, noise=0.05) for k in range(8)]
    run = functools.partial(optimize, solver="levenberg-marquardt")
    expected = [run(graph) for graph in graphs]
    for cache in (registry.trees, registry.plans, registry.systems):
        cache.clear()
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(run, graphs))
    for one, other in zip(found, expected, strict=True):
        values = (lie.parameters(solution.graph.poses) for solution in (one, other))
        np.testing.assert_array_equal(*values)
        assert one.cost == other.cost
    assert registry.spare.nbytes == 0


def test_maps_of_different_sizes_share_a_compilation(make_map):
    optimize(make_map(poses=28, loops=12, seed=1))
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, _, **__: compiled.append(event) if "backend_compile" in event else None
    )
    for poses in (25, 27, 29, 31, 32):
        optimize(make_map(poses=poses, loops=12, seed=poses))
    # The random maps themselves are made of eager JAX; the solver must not compile again.
    before = len(compiled)
    graph = make_map(poses=26, loops=13, seed=5)
    made = len(compiled)
    optimize(graph)
    assert len(compiled) == made, f"{made - before} while making the map"


@pytest.mark.slow
def test_float64_without_the_users_setting_and_on_one_core():
    """Also a check against deadlock: a callback that JAX must copy for hangs on one core."""
    program = """
import numpy as np, jax
import pcm_jax
from pcm_jax.simulation import simulate_city
from pcm_jax.mapping import optimize, joint_marginal_covariance
assert not jax.config.jax_enable_x64
graph = simulate_city(seed=0, poses=2000).graph.maps[0]
solution = optimize(graph)
leaves = jax.tree.leaves(solution.graph)
assert {str(leaf.dtype) for leaf in leaves} == {"float64", "int32"}, leaves
assert joint_marginal_covariance(solution.graph, np.array([3, 400])).dtype == np.float64
assert solution.converged
assert jax.numpy.ones(2).dtype == np.float32
print(repr(solution.cost))
"""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    pin = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
    pin = pin if hasattr(os, "sched_setaffinity") else ""
    result = subprocess.run(
        [sys.executable, "-c", pin + program],
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) > 0.0


REAL = {
    "classic2d/intel.g2o.xz": 22.502117,
    "classic2d/manhattan.g2o.xz": 1774.5205,
    "kitti_robust/00/kitti_00_odom_GT_LC.g2o.xz": 49.161069,
    "city10000/city10000.g2o.xz": 255.99373,
    "classic3d/parking-garage.g2o.xz": 0.6341924,
    "classic3d/sphere2500.g2o.xz": 675.70096,
    "classic3d/torus3D.g2o.xz": 12117.637,
    "classic3d/cubicle.g2o.xz": 1372.7883,
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pcm_jax.errors.InputWarning")
@pytest.mark.parametrize("name", REAL)
def test_costs_of_public_graphs(shared_data, name):
    repair = "clip" if "cubicle" in name else None
    (graph,) = read_graph(shared_data / name, repair=repair).maps
    solution = optimize(graph)
    assert solution.converged
    np.testing.assert_allclose(solution.cost, REAL[name], rtol=1e-6)


def turning_walk(group, seed, sigma_rotation):
    """Sixty poses of a walk that turns at random, and 25 loops; rotations are poor."""
    generator, d = np.random.default_rng(seed), group.tangent_dim
    space = 2 if d == 3 else 3
    steps = np.zeros((59, d))
    steps[:, 0] = 1.0
    steps[:, space:] = 0.5 * generator.normal(size=(59, d - space))
    poses = [lie.as_numpy(group.identity())]
    for step in lie.as_numpy(group.exp(steps)).parameters():
        poses.append(lie.compose(poses[-1], type(poses[0])(step)))
    truth = type(poses[0])(np.stack([lie.parameters(pose) for pose in poses]))
    ends = generator.integers(0, 60, (2, 25))
    tail, head = np.hstack([[np.arange(59), np.arange(1, 60)], ends[:, ends[0] != ends[1]]])
    sigmas = np.where(np.arange(d) < space, 0.1, sigma_rotation)
    noise = lie.as_numpy(group.exp(sigmas * generator.normal(size=(len(tail), d))))
    measured = lie.compose(lie.between(lie.take(truth, tail), lie.take(truth, head)), noise)
    information = np.broadcast_to(np.diag(sigmas**-2.0), (len(tail), d, d))
    return PoseGraph.from_arrays(
        poses=truth, tail=tail, head=head, measurement=measured, information=information
    )


@pytest.mark.parametrize(("seed", "rotation"), [(3, 0.7), (0, 0.4)])
def test_other_starts_are_tried_where_the_first_is_doubted(seed, rotation):
    """From the chordal start these do not converge, or to what can hardly be."""
    walk = turning_walk(jaxlie.SE2, seed, rotation)
    first = optimize_from("chordal", walk, solver="gauss-newton")
    assert not first.converged or first.cost > 100.0
    solution = optimize(walk)
    assert solution.converged and solution.start != "chordal"
    assert solution.cost < 0.9 * first.cost
    assert solution.cost == pytest.approx(optimize(walk, initial=solution.start).cost, rel=1e-12)
    assert f"from {solution.start} poses" in repr(solution)


@pytest.mark.parametrize(("share", "doubted"), [(0.99, True), (1.01, False)])
def test_a_cost_is_doubted_where_chance_hardly_gives_it(make_map, share, doubted):
    """Twice the cost is chi-squared, of d degrees for every edge that closes a loop."""
    graph = make_map(jaxlie.SE2, poses=12, loops=5)
    freedom = 3 * (graph.num_edges - 11)
    cost = 0.5 * chi2.isf(share * UNLIKELY, freedom)
    found = Solution(graph, cost, cost, 3, True)
    problem = SimpleNamespace(cost=lambda _: np.inf)
    assert bool(_is_suspicious(graph, problem, found)) is doubted
    assert _is_suspicious(graph, problem, dataclasses.replace(found, converged=False))
    assert not _is_suspicious(graph, None, found)


def test_poses_that_cost_less_are_taken_up():
    """A local optimum that fits well enough, and a file whose poses are at a better one."""
    walk = turning_walk(jaxlie.SE3, 6, 0.4)
    better = optimize(walk, initial="given")
    first = optimize(walk)
    assert first.converged and better.cost < first.cost  # nothing tells
    again = optimize(better.graph)
    assert again.start == "given" and again.cost == pytest.approx(better.cost)
    assert not first.certificate.certified


def test_a_good_fit_is_not_doubted(monkeypatch):
    """No other start is tried, be the given poses worse or what was found before."""
    tried = []

    def counted(initial, *arguments, **options):
        tried.append(initial)
        return optimize_from(initial, *arguments, **options)

    monkeypatch.setattr("pcm_jax.mapping.optimization.optimize_from", counted)
    solution = optimize(turning_walk(jaxlie.SE2, 1, 0.2))
    assert optimize(solution.graph).cost == pytest.approx(solution.cost)
    assert tried == ["chordal", "chordal"]
