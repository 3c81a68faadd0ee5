"""q² of the closures inside one map: against two definitions, and what must not change it."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from within_worlds import random_chain, with_edges

from pcm_jax import lie
from pcm_jax.consistency import (
    consistency_problem,
    loop_error,
    odometry_edges,
    squared_mahalanobis,
    squared_own_loops,
    within_problem,
)
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.lie import unrolled

POSES, COUNT = 12, 20
ALL = np.arange(POSES - 1 + COUNT)
OFF_DIAGONAL = ~np.eye(COUNT, dtype=bool)


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=lambda group: group.__name__)
def chain(request):
    return random_chain(request.param, poses=POSES, count=COUNT)


@pytest.fixture(scope="module")
def problem(chain):
    return within_problem(chain)


@pytest.fixture(scope="module")
def squared(problem):
    return np.asarray(squared_mahalanobis(problem))


@pytest.fixture(scope="module")
def own(problem):
    return np.asarray(squared_own_loops(problem))


def assert_same(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@pytest.mark.slow
def test_closed_form_is_the_definition(problem, squared):
    definition = np.asarray(squared_mahalanobis(problem, kernel="jacfwd"))
    assert squared[OFF_DIAGONAL].min() > 1e-3  # relative errors mean something
    assert np.abs(squared - squared.T).max() > 1e-2  # and so do directions
    np.testing.assert_allclose(squared, definition, rtol=1e-10)
    np.testing.assert_array_equal(np.diagonal(squared), 0.0)


def propagated(residual, covariances, h=1e-3):
    """εᵀ Σ⁻¹ ε of a residual of independent errors: J by differences of fourth order.

    The residual maps `[k, arguments, d]` errors to `[pairs, k, d]`.
    """
    size, d = covariances.shape[1:3]
    moves = h * np.eye(size * d).reshape(-1, size, d)
    error = residual(np.zeros((1, size, d)))[:, 0]
    near, far = (residual(k * moves) - residual(-k * moves) for k in (1, 2))
    jacobian = ((8 * near - far) / (12 * h)).reshape(len(error), size, d, d)
    total = np.einsum("pnai,pnab,pnbj->pij", jacobian, covariances, jacobian)
    return np.einsum("pi,pi->p", error, np.linalg.solve(total, error[..., None])[..., 0])


def test_errors_of_single_steps(chain, problem, squared, own):
    """Steps of odometry and closures, all independent: no covariance of any pose."""
    steps = lie.take(lie.as_numpy(chain.measurement), slice(POSES - 1))
    of_steps = np.linalg.inv(chain.information[: POSES - 1])
    start, end = np.sort([chain.tail, chain.head], axis=0)[:, POSES - 1 :]
    z, of_z = lie.as_numpy(problem.measurement), np.asarray(problem.measurement_covariance)

    def poses(delta):
        moved = lie.compose(steps, lie.exp(chain.group, delta))
        walked = [lie.identity(chain.group, (len(delta),))]
        for step in range(POSES - 1):
            walked.append(lie.compose(walked[-1], lie.take(moved, np.s_[:, step])))
        return lie.stack(walked)

    def measured(closures, delta):
        return lie.compose(lie.take(z, closures[:, None]), lie.exp(chain.group, delta[None]))

    u, v = np.nonzero(OFF_DIAGONAL)

    def pair(delta):
        x_i, x_j, x_k, x_l = (
            lie.take(poses(delta[:, 2:]), ends[w]) for ends in (start, end) for w in (u, v)
        )
        z_u, z_v = measured(u, delta[:, 0]), measured(v, delta[:, 1])
        return loop_error(z_u, lie.between(x_i, x_j), z_v, lie.between(x_l, x_k))

    def alone(delta):
        x_i, x_k = (lie.take(poses(delta[:, 1:]), ends) for ends in (start, end))
        z_u = measured(np.arange(COUNT), delta[:, 0])
        return lie.log(lie.between(z_u, lie.between(x_i, x_k)))

    def with_steps(*closures):
        own = (of_z[closure][:, None] for closure in closures)
        shared = np.broadcast_to(of_steps, (len(closures[0]), *of_steps.shape))
        return np.concatenate([*own, shared], axis=1)

    assert_same(propagated(pair, with_steps(u, v)), squared[u, v], 1e-9)
    assert_same(propagated(alone, with_steps(np.arange(COUNT))), own, 1e-9)


@pytest.mark.parametrize(
    "reverse", [[3, 7], [POSES, POSES + 5], ALL], ids=["steps", "loops", "all"]
)
def test_the_stored_direction_does_not_matter(chain, squared, own, reverse):
    turned = within_problem(with_edges(chain, ALL, reverse=reverse))
    assert_same(squared_mahalanobis(turned), squared, 1e-9)
    assert_same(squared_own_loops(turned), own, 1e-9)


def test_the_order_of_edges_does_not_matter_but_for_the_order_of_closures(chain, squared):
    order = np.random.default_rng(1).permutation(ALL)
    loops = order[order >= POSES - 1] - (POSES - 1)
    mixed = squared_mahalanobis(within_problem(with_edges(chain, order)))
    assert_same(mixed, squared[np.ix_(loops, loops)], 1e-9)


def moved(problem, motion):
    """The problem in another frame: left perturbations are carried by the motion's adjoint."""
    adjoint = np.asarray(lie.adjoint(motion))
    entries = unrolled.unpack(np.asarray(problem.cumulated_covariance))
    carried = adjoint @ np.moveaxis(np.array(entries), -1, 0) @ adjoint.T
    return dataclasses.replace(
        problem,
        pose_a=lie.compose(motion, lie.as_numpy(problem.pose_a)),
        pose_b=lie.compose(motion, lie.as_numpy(problem.pose_b)),
        cumulated_covariance=np.stack(unrolled.pack(unrolled.from_array(carried))),
    )


@pytest.mark.parametrize("kernel", ["closed-form", pytest.param("jacfwd", marks=pytest.mark.slow)])
def test_the_frame_does_not_matter(problem, squared, own, kernel):
    group = lie.group_of(problem.measurement)
    tangent = 3.0 * np.random.default_rng(2).normal(size=lie.tangent_dim(group))
    turned = moved(problem, lie.exp(group, tangent))
    assert_same(squared_mahalanobis(turned, kernel=kernel), squared, 1e-9)
    assert_same(squared_own_loops(turned), own, 1e-9)


def test_the_given_poses_do_not_matter(chain, squared):
    elsewhere = lie.exp(
        chain.group, np.random.default_rng(3).normal(size=(POSES, chain.tangent_dim))
    )
    assert_same(squared_mahalanobis(within_problem(chain.with_poses(elsewhere))), squared, 1e-12)


def line(closures, steps=25, variance=1e-3):
    """The real line: steps of unit variance and length, closures of hardly any."""
    tail, head = np.array([*((s, s + 1) for s in range(steps)), *closures]).T
    return PoseGraph.from_arrays(
        tail=tail,
        head=head,
        measurement=lie.R1(1.0 * (head - tail)[:, None] + (np.arange(len(tail)) == steps)[:, None]),
        covariance=np.where(np.arange(len(tail)) < steps, 1.0, variance)[:, None, None],
    )


def with_turned(problem, closure):
    """One closure turned to run backward."""
    ends = {"pose_a": problem.pose_b, "pose_b": problem.pose_a}
    rows = {"row_a": problem.row_b, "row_b": problem.row_a}
    turned = np.arange(len(problem.valid)) == closure

    def choose(new, old):
        shape = (-1,) + (1,) * (old.ndim - 1)
        return jnp.where(turned.reshape(shape), new, old)

    fields = {"measurement": lie.inverse(problem.measurement), **ends, **rows}
    return dataclasses.replace(
        problem,
        **{name: jax.tree.map(choose, new, getattr(problem, name)) for name, new in fields.items()},
    )


@pytest.mark.parametrize("kernel", ["closed-form", "jacfwd"])
def test_shared_odometry_counts_with_its_sign(kernel):
    """Closures 0 → 25 (off by one) and 5 → 20: 5 + 5 steps are not shared.

    With the second turned to 20 → 5, the loop walks 0 … 20 and 5 … 25, so 15 steps twice, and has
    the variance 10 + 4 · 15 = 70; two independent maps would give 20 + 20.
    """
    problem = within_problem(line([(0, 25), (20, 5)]))
    noise = 2e-3
    assert squared_mahalanobis(problem, kernel=kernel)[0, 1] == pytest.approx(1 / (10 + noise))
    turned = with_turned(problem, 1)
    assert squared_mahalanobis(turned, kernel=kernel)[0, 1] == pytest.approx(1 / (70 + noise))


def test_independent_sides_are_wrong():
    """The same loop, taken between two maps that happen to be equal."""
    graph = line([(0, 25), (20, 5)])
    chain = with_edges(graph, np.arange(25))
    closures = LoopClosures.from_arrays(
        robot_a=[0, 0],
        pose_a=[0, 20],
        robot_b=[1, 1],
        pose_b=[25, 5],
        measurement=lie.take(lie.as_numpy(graph.measurement), slice(25, None)),
        information=np.asarray(graph.information)[25:],
    )
    steps = np.array([0.0, 20.0]), np.array([5.0, 25.0])
    joint = tuple(np.minimum(index[:, None], index) for index in steps)
    problem = consistency_problem(chain, chain, closures, marginals=joint)
    assert squared_mahalanobis(problem)[0, 1] == pytest.approx(1 / (40 + 2e-3))


def test_one_closure_with_odometry():
    squared = squared_own_loops(within_problem(line([(0, 25), (20, 5)])))
    np.testing.assert_allclose(squared, [1 / (25 + 1e-3), 0.0], atol=1e-12)


def test_a_long_way_before_costs_no_digits():
    """The last closures of a long drive, with and without the drive before them."""
    rng = np.random.default_rng(4)
    n, last = 5000, 60
    steps = lie.exp(jaxlie.SE2, [1.0, 0.0, 0.0] + 0.05 * rng.normal(size=(n - 1, 3)))
    whole = PoseGraph.from_arrays(
        tail=np.arange(n - 1),
        head=np.arange(1, n),
        measurement=steps,
        covariance=np.tile(np.diag([1e-4, 1e-4, 1e-6]), (n - 1, 1, 1)),
    )
    loops = np.array([[0, 2], *np.sort([rng.choice(last, 2, replace=False) for _ in range(9)])])
    loops[1:] += n - last

    def with_loops(loops, first):
        poses = lie.as_numpy(whole.poses)
        tail, head = loops.T
        exact = lie.between(lie.take(poses, tail), lie.take(poses, head))
        off = lie.exp(jaxlie.SE2, 0.05 * np.arange(30.0).reshape(10, 3)[-len(loops) :])
        covariance = np.tile(np.diag([1e-3, 1e-3, 1e-4]), (len(loops), 1, 1))
        odometry = slice(first, None)
        return PoseGraph.from_arrays(
            tail=np.concatenate([whole.tail[odometry], tail]) - first,
            head=np.concatenate([whole.head[odometry], head]) - first,
            measurement=lie.concatenate(
                [lie.take(lie.as_numpy(whole.measurement), odometry), lie.compose(exact, off)]
            ),
            information=np.concatenate([whole.information[odometry], np.linalg.inv(covariance)]),
        )

    far = np.asarray(squared_mahalanobis(within_problem(with_loops(loops, 0))))[1:, 1:]
    near = squared_mahalanobis(within_problem(with_loops(loops[1:], n - last)))
    np.testing.assert_allclose(far, near, rtol=1e-7)


def test_padding_changes_nothing(chain, problem, squared, own):
    part = within_problem(with_edges(chain, ALL[:-3]))
    assert jax.tree.map(jnp.shape, part) == jax.tree.map(jnp.shape, problem)  # one compilation
    assert_same(squared_mahalanobis(part), squared[:-3, :-3], 1e-11)
    assert_same(squared_own_loops(part), own[:-3], 1e-11)


def test_no_closures_at_all(chain):
    nothing = within_problem(with_edges(chain, ALL[: POSES - 1]))
    assert squared_mahalanobis(nothing).shape == (0, 0)
    assert squared_own_loops(nothing).shape == (0,)


def test_several_tiles():
    graph = random_chain(jaxlie.SE2, seed=5, poses=60, count=150)
    part = np.r_[np.arange(59), 59 + np.array([0, 3, 70, 149])]
    found = np.asarray(squared_mahalanobis(within_problem(graph)))
    expected = squared_mahalanobis(within_problem(with_edges(graph, part)), kernel="jacfwd")
    assert_same(found[np.ix_(part[59:] - 59, part[59:] - 59)], expected, 1e-9)


@pytest.mark.slow
def test_inside_jit_padding_is_infinite(problem, squared, own):
    padded = np.asarray(jax.jit(squared_mahalanobis)(problem))
    assert_same(padded[:COUNT, :COUNT], squared, 1e-12)
    assert np.isposinf(padded[COUNT:, :COUNT]).all()
    alone = np.asarray(jax.jit(squared_own_loops)(problem))
    assert_same(alone[:COUNT], own, 1e-12)
    assert np.isposinf(alone[COUNT:]).all()


@pytest.mark.slow
def test_derivatives():
    """Along a random direction in every input at once, against central differences."""
    problem = within_problem(random_chain(jaxlie.SE3, poses=POSES, count=COUNT))
    rng = np.random.default_rng(6)
    weights = jnp.asarray(rng.uniform(size=(COUNT, COUNT)))
    size, d, _ = problem.measurement_covariance.shape
    lies = ("measurement", "pose_a", "pose_b")
    direction = {name: rng.normal(size=(size, d)) for name in lies} | {
        "measurement_covariance": 1e-3 * np.eye(d) * rng.normal(size=(size, 1, 1)),
        "cumulated_covariance": 1e-4 * rng.normal(size=problem.cumulated_covariance.shape),
    }

    def value(t, at):
        changes = {}
        for name, step in direction.items():
            old = getattr(at, name)
            if name in lies:
                changes[name] = lie.compose(old, lie.exp(lie.group_of(old), t * step))
            else:
                changes[name] = old + t * step
        replaced = dataclasses.replace(at, **changes)
        return jnp.sum(weights * squared_mahalanobis(replaced)[:COUNT, :COUNT])

    run = jax.jit(lambda t, at: jax.jvp(lambda t: value(t, at), (t,), (1.0,)))
    h = 1e-5
    difference = (run(h, problem)[0] - run(-h, problem)[0]) / (2 * h)
    slope = run(0.0, problem)[1]
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.slow
def test_gradients_by_transposition():
    """Of the sum over all pairs, with respect to what odometry has added up to each pose."""
    problem = within_problem(random_chain(jaxlie.SE2, seed=7, poses=POSES, count=COUNT))
    cumulated = problem.cumulated_covariance
    direction = np.random.default_rng(8).normal(size=cumulated.shape)

    def value(cumulated):
        replaced = dataclasses.replace(problem, cumulated_covariance=cumulated)
        return jnp.sum(squared_mahalanobis(replaced))

    by_gradient = jnp.vdot(jax.jit(jax.grad(value))(cumulated), direction)
    h = 1e-7
    difference = (value(cumulated + h * direction) - value(cumulated - h * direction)) / (2 * h)
    np.testing.assert_allclose(by_gradient, difference, rtol=1e-5)


def test_the_first_of_several_edges_is_the_odometry():
    graph = line([(3, 2), (0, 25)])
    order = np.r_[25, np.arange(25), 26]
    assert odometry_edges(graph).tolist() == list(range(25))
    assert odometry_edges(with_edges(graph, order)).tolist() == [1, 2, 0, *range(4, 26)]


def test_a_broken_chain_is_named():
    graph = line([(0, 25), (20, 5)])
    broken = with_edges(graph, np.delete(np.arange(27), 12))
    broken = dataclasses.replace(broken, name="c", ids=np.arange(100, 126))
    with pytest.raises(InputError) as caught:
        within_problem(broken)
    assert str(caught.value) == (
        "map 'c': no edge joins poses c112 and c113, expected odometry between all consecutive"
        " poses; split(pose_graph, [13]) cuts it there"
    )
