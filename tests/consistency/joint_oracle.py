"""The joint graph of two maps and closures, solved densely by Gauss-Newton with differences.

Shares nothing with what it tests but exp, log and the graph's arrays: no covariance, no adjoint.
"""

import numpy as np

from pcm_jax import lie
from pcm_jax.consistency import PairEvidence
from pcm_jax.graph import LoopClosures, PoseGraph
from pcm_jax.mapping import MapCovariance, optimize

STEP = 1e-5


def minimum(group, poses, edges):
    """The poses of least Σ rᵀΩr, and that sum.

    Args:
        poses: Lie [n]; the first of each connected part must be held by an edge's absence: a free
            gauge is taken out by the least-norm step.
        edges: a function from poses to residuals [r, d], and information [r, d, d].
    """
    residuals, information = edges
    root = np.linalg.cholesky(information).swapaxes(1, 2)
    d = lie.tangent_dim(group)

    def white(moves):
        moved = lie.compose(poses, lie.exp(group, moves.reshape(-1, d)))
        return (root @ residuals(moved)[..., None]).reshape(-1)

    size = len(lie.parameters(poses)) * d
    for _ in range(8):
        now = white(np.zeros(size))
        jacobian = np.stack(
            [(white(STEP * one) - white(-STEP * one)) / (2 * STEP) for one in np.eye(size)], axis=1
        )
        step = -np.linalg.lstsq(jacobian, now, rcond=1e-9)[0]
        poses = lie.compose(poses, lie.exp(group, step.reshape(-1, d)))
        if np.abs(step).max() < 1e-9:
            break
    return poses, float(white(np.zeros(size)) @ white(np.zeros(size)))


def map_edges(graph):
    """Residuals and information of a map's own edges."""
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    measured = lie.as_numpy(graph.measurement)

    def residuals(poses):
        relative = lie.between(lie.take(poses, tail), lie.take(poses, head))
        return lie.log(lie.between(measured, relative))

    return residuals, np.asarray(graph.information)


def merged(map_a, map_b, closures, group_of_each, start):
    """Twice the least cost of both maps, closures, and one anchor of map b a group of closures.

    Returns:
        that, and the anchors T with T Y in map a's frame.
    """
    group, a, b = closures.group, map_a.num_poses, map_b.num_poses
    own = [map_edges(map_a), map_edges(map_b)]
    measured = lie.as_numpy(closures.measurement)
    anchor = a + b + np.asarray(group_of_each)

    def residuals(poses):
        from_a = lie.take(poses, np.asarray(closures.pose_a))
        in_a = lie.compose(
            lie.take(poses, anchor), lie.take(poses, a + np.asarray(closures.pose_b))
        )
        across = lie.log(lie.between(measured, lie.between(from_a, in_a)))
        maps = lie.take(poses, slice(0, a)), lie.take(poses, slice(a, a + b))
        inside = [part(one) for (part, _), one in zip(own, maps, strict=True)]
        return np.concatenate([*inside, across])

    information = np.concatenate([*(part for _, part in own), np.asarray(closures.information)])
    anchors = [start] * (int(np.max(group_of_each)) + 1)
    poses = [lie.as_numpy(map_a.poses), lie.as_numpy(map_b.poses), lie.stack(anchors)]
    found, cost = minimum(group, lie.concatenate(poses), (residuals, information))
    # Each map's own frame is where its first pose was.
    first_a, first_b = (lie.take(one, 0) for one in poses[:2])
    to_a = lie.compose(first_a, lie.inverse(lie.take(found, 0)))
    from_b = lie.compose(lie.take(found, a), lie.inverse(first_b))
    placed = lie.take(found, slice(a + b, None))
    return cost, lie.compose(lie.compose(to_a, placed), from_b)


def noisy_world(group, rng, *, sigma=0.01, poses=6, count=5, truth=None):
    """Two optimised maps with loops and closures that share poses, errors as their covariance says.

    Returns:
        maps, closures, twice the maps' costs, and the true alignment of their frames.
    """
    d = lie.tangent_dim(group)
    truth = lie.exp(group, rng.normal(size=d)) if truth is None else truth
    maps, costs, places = [], [], []
    for _ in range(2):
        placed = lie.exp(group, rng.normal(size=(poses, d)))
        tail = np.array([*range(poses - 1), 0, poses - 1])
        head = np.array([*range(1, poses), poses // 2, 1])
        exact = lie.between(lie.take(placed, tail), lie.take(placed, head))
        covariance = drawn_covariances(rng, len(tail), d, sigma)
        one = PoseGraph.from_arrays(
            poses=placed,
            tail=tail,
            head=head,
            measurement=lie.compose(exact, lie.exp(group, drawn(rng, covariance))),
            covariance=covariance,
        )
        solution = optimize(one, initial="given")
        maps.append(solution.graph)
        costs.append(2.0 * solution.cost)
        places.append(placed)
    pose_a, pose_b = rng.integers(0, poses, (2, count))
    pose_a[:2] = pose_a[0]
    pose_b[-2:] = pose_b[-1]
    in_a = lie.compose(truth, lie.take(places[1], pose_b))
    covariance = drawn_covariances(rng, count, d, sigma)
    exact = lie.between(lie.take(places[0], pose_a), in_a)
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=pose_a,
        robot_b=np.ones(count, int),
        pose_b=pose_b,
        measurement=lie.compose(exact, lie.exp(group, drawn(rng, covariance))),
        covariance=covariance,
    )
    # As their own frames have it, in which their first poses are where the optimum left them.
    to_a, from_b = (
        lie.compose(lie.take(lie.as_numpy(one.poses), 0), lie.inverse(lie.take(exactly, 0)))
        for one, exactly in zip(maps, places, strict=True)
    )
    truth = lie.compose(lie.compose(to_a, truth), lie.inverse(from_b))
    return maps, closures, costs, truth


def drawn_covariances(rng, count, d, sigma):
    """Random covariances, condition about ten."""
    root = rng.normal(size=(count, d, 3 * d))
    return sigma**2 * (root @ root.swapaxes(1, 2) / (3 * d) + 0.1 * np.eye(d))


def drawn(rng, covariance):
    """A normal draw of each."""
    root = np.linalg.cholesky(covariance)
    return (root @ rng.normal(size=(*covariance.shape[:2], 1)))[..., 0]


def evidence_of(maps, closures, squared=None):
    """The evidence that `weigh` would make of optimised maps."""
    covariances = tuple(map(MapCovariance, maps))
    rows = np.arange(len(closures))
    return PairEvidence(0, 1, rows, closures, covariances, _squared=squared)
