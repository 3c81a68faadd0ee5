"""Small maps of one robot for these tests: odometry first, closures after it."""

import consistency_worlds as worlds
import numpy as np

from pcm_jax import lie
from pcm_jax.graph import PoseGraph


def random_chain(group, seed=0, poses=12, count=20, noise=0.05):
    """Steps of odometry, and closures between random poses, stored in either direction.

    None joins consecutive poses, so that it cannot be taken for odometry.
    """
    rng = np.random.default_rng(seed)
    d = lie.tangent_dim(group)
    placed = lie.exp(group, rng.normal(size=(poses, d)))
    apart = np.argwhere(np.abs(np.subtract.outer(np.arange(poses), np.arange(poses))) > 1)
    loops = rng.choice(apart, count)
    tail, head = np.array([*zip(range(poses - 1), range(1, poses), strict=True), *loops]).T
    exact = lie.between(lie.take(placed, tail), lie.take(placed, head))
    return PoseGraph.from_arrays(
        poses=placed,
        tail=tail,
        head=head,
        measurement=lie.compose(exact, lie.exp(group, noise * rng.normal(size=(len(tail), d)))),
        covariance=worlds.positive_definite(rng, len(tail), d, noise),
    )


def with_edges(graph, rows, *, reverse=(), measurement=None):
    """Some of the edges, in the order given; those whose index is in `reverse` turned round."""
    edges = lie.as_numpy(graph.measurement if measurement is None else measurement)
    turned = np.isin(np.arange(graph.num_edges), reverse)
    back = lie.adjoint(lie.inverse(edges))  # z exp(δ) = (z⁻¹ exp(−Ad(z) δ))⁻¹
    information = np.asarray(graph.information)
    ends = np.asarray(graph.tail), np.asarray(graph.head)
    values = np.where(turned[:, None], lie.parameters(lie.inverse(edges)), lie.parameters(edges))
    information = np.where(
        turned[:, None, None], back.swapaxes(1, 2) @ information @ back, information
    )
    return PoseGraph.from_arrays(
        poses=graph.poses,
        tail=np.where(turned, *ends[::-1])[rows],
        head=np.where(turned, *ends)[rows],
        measurement=graph.group(values[rows]),
        information=information[rows],
    )
