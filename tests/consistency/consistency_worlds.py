"""Small worlds for these tests: maps, closures, and dense joint marginals worked out by hand."""

import numpy as np

from pcm_jax import lie
from pcm_jax.graph import LoopClosures, PoseGraph


def positive_definite(rng, count, size, scale):
    """Random covariances `[count, size, size]`, condition about ten."""
    root = rng.normal(size=(count, size, 3 * size))
    return scale**2 * (root @ root.swapaxes(-1, -2) / (3 * size) + 0.1 * np.eye(size))


def random_map(group, rng, poses=9, loops=4, noise=0.05):
    """A chain with loops; poses near, not at, the optimum (every formula holds at any point)."""
    d = lie.tangent_dim(group)
    placed = lie.exp(group, rng.normal(size=(poses, d)))
    extra = np.array([rng.choice(poses, 2, replace=False) for _ in range(loops)])
    tail = np.concatenate([np.arange(poses - 1), extra[:, 0]])
    head = np.concatenate([np.arange(1, poses), extra[:, 1]])
    exact = lie.between(lie.take(placed, tail), lie.take(placed, head))
    moved = lie.compose(exact, lie.exp(group, noise * rng.normal(size=(len(tail), d))))
    covariance = positive_definite(rng, len(tail), d, noise)
    return PoseGraph.from_arrays(
        poses=placed, tail=tail, head=head, measurement=moved, covariance=covariance
    )


def random_closures(group, rng, map_a, map_b, count, noise=0.2):
    """Closures between random poses; some poses are touched by several."""
    d = lie.tangent_dim(group)
    pose_a, pose_b = (
        rng.integers(0, len(lie.parameters(graph.poses)), count) for graph in (map_a, map_b)
    )
    ends = (
        lie.take(lie.as_numpy(graph.poses), k) for graph, k in ((map_a, pose_a), (map_b, pose_b))
    )
    moved = lie.compose(lie.between(*ends), lie.exp(group, noise * rng.normal(size=(count, d))))
    return LoopClosures.from_arrays(
        robot_a=np.zeros(count, int),
        pose_a=pose_a,
        robot_b=np.ones(count, int),
        pose_b=pose_b,
        measurement=moved,
        covariance=positive_definite(rng, count, d, 0.1),
    )


def random_world(group, seed=0, count=20):
    """Two maps and closures between them."""
    rng = np.random.default_rng(seed)
    map_a, map_b = random_map(group, rng), random_map(group, rng)
    return map_a, map_b, random_closures(group, rng, map_a, map_b, count)


def moved_map(graph, motion):
    """The same map in another frame."""
    return graph.with_poses(lie.compose(motion, lie.as_numpy(graph.poses)))


def dense_covariance(graph, fixed=0):
    """Covariance of all poses, right perturbations, `[n, d, n, d]`: the inverse of JᵀΩJ."""
    poses, edges = lie.as_numpy(graph.poses), lie.as_numpy(graph.measurement)
    tail, head = np.asarray(graph.tail), np.asarray(graph.head)
    relative = lie.between(lie.take(poses, tail), lie.take(poses, head))
    error = lie.log(lie.between(edges, relative))
    to_head = lie.right_jacobian_inverse(graph.group, error)
    to_tail = -to_head @ lie.adjoint(lie.inverse(relative))
    n, d = len(lie.parameters(poses)), graph.tangent_dim
    jacobian = np.zeros((len(tail), d, n, d))
    for e in range(len(tail)):
        jacobian[e, :, tail[e]] = to_tail[e]
        jacobian[e, :, head[e]] = to_head[e]
    flat = jacobian.reshape(len(tail), d, n * d)
    information = np.einsum("eip,eij,ejq->pq", flat, np.asarray(graph.information), flat)
    free = np.repeat(np.arange(n) != fixed, d)
    covariance = np.zeros((n * d, n * d))
    covariance[np.ix_(free, free)] = np.linalg.inv(information[np.ix_(free, free)])
    return covariance.reshape(n, d, n, d)


def touched_marginal(graph, touching, fixed=0):
    """The part of `dense_covariance` that `consistency_problem(marginals=)` takes."""
    touched = np.unique(np.asarray(touching))
    covariance = dense_covariance(graph, fixed)[touched][:, :, touched]
    return covariance.reshape(len(touched) * graph.tangent_dim, -1)


def marginals_of(map_a, map_b, closures, fixed=(0, 0)):
    """Both maps' marginals."""
    return (
        touched_marginal(map_a, closures.pose_a, fixed[0]),
        touched_marginal(map_b, closures.pose_b, fixed[1]),
    )


def naive_squared(map_a, map_b, closures, u, v):
    """Eq. 4 for one pair, from right perturbations of the four poses and two measurements."""
    group = closures.group
    covariance_a, covariance_b = dense_covariance(map_a), dense_covariance(map_b)
    noise = np.linalg.inv(np.asarray(closures.information))
    z = [lie.take(lie.as_numpy(closures.measurement), index) for index in (u, v)]
    i, j = (int(closures.pose_a[index]) for index in (u, v))
    k, l = (int(closures.pose_b[index]) for index in (u, v))  # noqa: E741
    x_i, x_j = (lie.take(lie.as_numpy(map_a.poses), index) for index in (i, j))
    y_k, y_l = (lie.take(lie.as_numpy(map_b.poses), index) for index in (k, l))
    x_ij, y_lk = lie.between(x_i, x_j), lie.between(y_l, y_k)
    after_j = lie.compose(z[1], y_lk)
    after_i = lie.compose(x_ij, after_j)
    loop = lie.compose(lie.inverse(z[0]), after_i)
    error = lie.log(loop)

    def suffix(transform, sign):
        return sign * lie.adjoint(lie.inverse(transform))

    def pair(covariance, a, b):
        return covariance[[a, b]][:, :, [a, b]].reshape(2 * len(error), -1)

    outer = lie.right_jacobian_inverse(group, error)
    side_a = outer @ np.hstack([suffix(after_i, -1.0), suffix(after_j, 1.0)])
    side_b = outer @ np.hstack([np.eye(len(error)), suffix(y_lk, -1.0)])
    z_u, z_v = outer @ suffix(loop, -1.0), outer @ suffix(y_lk, 1.0)
    total = (
        side_a @ pair(covariance_a, i, j) @ side_a.T
        + side_b @ pair(covariance_b, k, l) @ side_b.T
        + z_u @ noise[u] @ z_u.T
        + z_v @ noise[v] @ z_v.T
    )
    return error @ np.linalg.solve(total, error)
