"""Monte Carlo: a 95 % gate lets 95 % of the pairs of right closures pass.

Each world has two small maps with loops, all noise drawn as measured = true · exp(noise). The maps
are optimised and their joint covariances taken by a dense solver of a few lines here, so that
nothing of the package but the matter under test takes part.
"""

import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from pcm_jax import lie
from pcm_jax.consistency import chi2_gate, consistency_problem, squared_mahalanobis
from pcm_jax.graph import LoopClosures, PoseGraph

pytestmark = pytest.mark.slow


WORLDS, POSES, CLOSURES = 200, 7, 9
SIGMA = 0.01
CHAIN = [(i, i + 1) for i in range(POSES - 1)]
TAIL, HEAD = np.array([*CHAIN, (0, 3), (6, 1), (2, 5)]).T
STEPS = 4  # Gauss-Newton from the truth, noise of a hundredth


@functools.partial(jax.jit, static_argnums=0)
def dense_optimum(group, poses, measurement):
    """Optimised poses of one map, and the joint covariance of all; pose 0 is fixed."""
    d = lie.tangent_dim(group)

    def linearised(parameters):
        def at(index):
            return group(parameters[index])

        relative = lie.between(at(TAIL), at(HEAD))
        error = lie.log(lie.between(group(measurement), relative))
        to_head = lie.right_jacobian_inverse(group, error)
        to_tail = -to_head @ lie.adjoint(lie.inverse(relative))
        edges = jnp.arange(len(TAIL))
        jacobian = jnp.zeros((len(TAIL), d, POSES, d))
        jacobian = jacobian.at[edges, :, HEAD].set(to_head).at[edges, :, TAIL].set(to_tail)
        return error.reshape(-1), jacobian[:, :, 1:].reshape(len(TAIL) * d, -1)

    def step(_, parameters):
        error, jacobian = linearised(parameters)
        move = -jnp.linalg.solve(jacobian.T @ jacobian, jacobian.T @ error)
        move = jnp.concatenate([jnp.zeros(d), move]).reshape(POSES, d)
        return lie.parameters(lie.compose(group(parameters), lie.exp(group, move)))

    optimum = jax.lax.fori_loop(0, STEPS, step, poses)
    jacobian = linearised(optimum)[1]
    covariance = SIGMA**2 * jnp.linalg.inv(jacobian.T @ jacobian)
    return optimum, jnp.pad(covariance, ((d, 0), (d, 0)))


def noisy(group, rng, exact):
    shape = (*exact.get_batch_axes(), lie.tangent_dim(group))
    return lie.compose(exact, lie.exp(group, SIGMA * rng.normal(size=shape)))


def optimised_maps(group, rng):
    """True poses, optimised poses, and joint covariances of `WORLDS` maps."""
    truth = lie.exp(group, rng.normal(size=(WORLDS, POSES, lie.tangent_dim(group))))
    ends = (lie.take(truth, np.s_[:, index]) for index in (TAIL, HEAD))
    measured = noisy(group, rng, lie.between(*ends))
    solve = jax.vmap(functools.partial(dense_optimum, group))
    optimum, covariance = solve(lie.parameters(truth), lie.parameters(measured))
    return truth, group(np.asarray(optimum)), np.asarray(covariance)


def independent(covariance):
    """The same marginals of each pose, the poses taken to be independent."""
    d = covariance.shape[-1] // POSES
    return covariance * np.kron(np.eye(POSES), np.ones((d, d)))


@pytest.fixture(scope="module", params=[jaxlie.SE2, jaxlie.SE3], ids=lambda group: group.__name__)
def accepted(request):
    """Shares of pairs within the 95 % gate: joint covariances, and independent poses."""
    group = request.param
    d = lie.tangent_dim(group)
    rng = np.random.default_rng(20180521)
    maps = [optimised_maps(group, rng) for _ in range(2)]
    # Every pose of either map is touched, so that marginals are whole covariances.
    touched = np.array([np.append(rng.permutation(POSES), [0, 1]) for _ in range(2 * WORLDS)])
    touched = touched.reshape(2, WORLDS, CLOSURES)
    unit = np.ones((len(TAIL), d, d)) * np.eye(d)
    squared = {"joint": [], "independent": []}
    for world in range(WORLDS):
        ends = [lie.take(lie.take(maps[k][0], world), touched[k, world]) for k in range(2)]
        closures = LoopClosures.from_arrays(
            robot_a=np.zeros(CLOSURES, int),
            pose_a=touched[0, world],
            robot_b=np.ones(CLOSURES, int),
            pose_b=touched[1, world],
            measurement=noisy(group, rng, lie.between(*ends)),
            covariance=SIGMA**2 * np.ones((CLOSURES, 1, 1)) * np.eye(d),
        )
        graphs = [
            PoseGraph.from_arrays(
                poses=lie.take(optimum, world),
                tail=TAIL,
                head=HEAD,
                measurement=lie.identity(group, (len(TAIL),)),
                information=unit,
            )
            for _, optimum, _ in maps
        ]
        joint = tuple(covariance[world] for _, _, covariance in maps)
        for name, marginals in (("joint", joint), ("independent", tuple(map(independent, joint)))):
            problem = consistency_problem(*graphs, closures, marginals=marginals)
            squared[name].append(squared_mahalanobis(problem))
    pairs = ~np.eye(CLOSURES, dtype=bool)
    gate = chi2_gate(0.95, d)
    return {name: np.mean(np.array(each)[:, pairs] <= gate) for name, each in squared.items()}


def test_joint_covariances_are_calibrated(accepted):
    assert 0.94 < accepted["joint"] < 0.96


def test_poses_taken_as_independent_are_not(accepted):
    assert accepted["independent"] > 0.97
