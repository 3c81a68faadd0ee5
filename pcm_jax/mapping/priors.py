"""Priors on poses: where they put a map, and what they leave free.

A prior is a unary residual `r = Log(z⁻¹ X)`, in the problem an edge from the frame itself (a last
pose at the identity, held) to the pose. Where a map has priors its frame is theirs, and no pose of
its own is held. To move the whole map by exp(ξ) costs, to first order,

    ξᵀ G ξ,  G = Σ Ad(X⁻¹)ᵀ Ω Ad(X⁻¹)

over the priors. Null directions of G are what they leave free: one position alone leaves the
rotations about it. In these, and in no other, the first pose is held to where the map has it
(`held`), a hundred times as sure as a measurement of the map: since the cost does not see them,
that moves the map by nothing but a motion of the whole. Relative covariances do not see it either.

A position's prior has no information on rotations, and `Log` mixes both where the rotation of z is
far from the pose's. Its z is turned to the pose's own rotation (`turned`), where the translational
part of `Log` is the position's error.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax import lie
from pcm_jax.graph import PoseGraph
from pcm_jax.graph.priors import Priors

FREE = 1e-10  # of the largest eigenvalue of G, in one unit: no information
SURE = 1e4  # times the median information of the map's measurements


def priors_of(pose_graph: PoseGraph) -> Priors | None:
    """The graph's priors; None for none, be it by an empty batch."""
    return pose_graph.priors if pose_graph.priors is not None and len(pose_graph.priors) else None


def turned(priors: Priors, poses: Any) -> Priors:
    """The same priors, those of positions alone with the rotations of `poses`, Lie `[n]`."""
    here = lie.take(lie.as_numpy(poses), priors.pose)
    space = lie.module_of(lie.group_of(here)).MATRIX_DIM - 1
    alone = position_only(priors)
    if not alone.any():
        return priors
    old = np.asarray(lie.parameters(priors.measurement))
    new = np.array(lie.parameters(here))
    new[:, -space:] = old[:, -space:]
    new = np.where(alone[:, None], new, old)
    measurement = lie.group_of(here)(new)
    before, after = (
        np.asarray(lie.as_matrix(each))[:, :space, :space]
        for each in (priors.measurement, measurement)
    )
    turn = before.swapaxes(1, 2) @ after
    information = np.array(priors.information)
    information[:, :space, :space] = np.where(
        alone[:, None, None],
        turn.swapaxes(1, 2) @ information[:, :space, :space] @ turn,
        information[:, :space, :space],
    )
    return dataclasses.replace(priors, measurement=measurement, information=information)


def position_only(priors: Priors) -> np.ndarray:
    """Marks the priors `[k]` without any information on rotations."""
    space = lie.module_of(lie.group_of(priors.measurement)).MATRIX_DIM - 1
    return np.asarray(~priors.information[:, space:].any(axis=(1, 2)))


def placed(poses: Any, priors: Priors) -> Any:
    """The poses, Lie `[n]`, moved as a whole to where the priors cost least.

    Of three places: where they are, where the surest prior with a rotation puts them, and where
    the priors' positions do (Kabsch 1976).
    """
    here = lie.take(lie.as_numpy(poses), priors.pose)
    motions = [lie.identity(lie.group_of(here))]
    whole = np.flatnonzero(~position_only(priors))
    if len(whole):
        surest = whole[np.argmax(np.trace(priors.information[whole], axis1=1, axis2=2))]
        measured = lie.take(priors.measurement, surest)
        motions.append(lie.compose(measured, lie.inverse(lie.take(here, surest))))
    if len(priors) > 1:
        motions.append(_kabsch(here, priors))
    moved = [lie.compose(motion, lie.as_numpy(poses)) for motion in motions]
    return moved[int(np.argmin([_cost(each, turned(priors, each)) for each in moved]))]


def _cost(poses: Any, priors: Priors) -> float:
    here = lie.take(poses, priors.pose)
    residual = np.asarray(lie.log(lie.between(priors.measurement, here)))
    return float(np.einsum("ki,kij,kj->", residual, priors.information, residual))


def _kabsch(here: Any, priors: Priors) -> Any:
    """The rigid motion of the poses' positions nearest to the priors', weighed by information."""
    space = lie.module_of(lie.group_of(here)).MATRIX_DIM - 1
    weight = np.trace(priors.information[:, :space, :space], axis1=1, axis2=2)
    weight = weight / weight.sum() if weight.sum() > 0.0 else np.full(len(weight), 1 / len(weight))
    found, wanted = lie.translation(here), lie.translation(priors.measurement)
    middles = weight @ found, weight @ wanted
    left, _, right = np.linalg.svd(
        ((wanted - middles[1]) * weight[:, None]).T @ (found - middles[0])
    )
    left[:, -1] *= np.linalg.det(left @ right)
    matrix = np.eye(space + 1)
    matrix[:space, :space] = left @ right
    matrix[:space, space] = middles[1] - matrix[:space, :space] @ middles[0]
    return lie.take(lie.from_matrix(matrix[None]), 0)  # type: ignore[arg-type]


def free_directions(priors: Priors, poses: Any) -> tuple[Float[np.ndarray, "d f"], Any]:
    """The null space of G, as left perturbations about the middle of the measured poses.

    Args:
        priors: at least one.
        poses: Lie `[n]`.

    Returns:
        Orthonormal columns, rotations times the spread of the measured poses; and the scale
        `[d]` that makes metres of perturbations.
    """
    here = _about_middle(lie.take(lie.as_numpy(poses), priors.pose), priors, poses)
    space = lie.module_of(lie.group_of(here)).MATRIX_DIM - 1
    positions = lie.translation(here)
    lever = max(float(np.sqrt((positions**2).sum(axis=1).mean())), 1.0)
    scale = np.ones(lie.tangent_dim(here))
    scale[space:] = lever
    back = np.asarray(lie.adjoint(lie.inverse(here))) / scale
    gauge = np.einsum("kia,kij,kjb->ab", back, priors.information, back)
    values, vectors = np.linalg.eigh(gauge)
    return vectors[:, values <= FREE * max(values[-1], np.finfo(float).tiny)], scale


def _about_middle(some: Any, priors: Priors, poses: Any) -> Any:
    values = np.array(lie.parameters(some))
    space = lie.module_of(lie.group_of(some)).MATRIX_DIM - 1
    values[:, -space:] -= lie.translation(lie.take(lie.as_numpy(poses), priors.pose)).mean(axis=0)
    return lie.group_of(some)(values)


def held(pose_graph: PoseGraph) -> Priors | None:
    """The priors of a map at its own poses, and what holds its first pose where they do not.

    Returns:
        None for a map without priors; the priors, if they leave nothing free; else one more.
    """
    priors = priors_of(pose_graph)
    if priors is None:
        return None
    poses = lie.as_numpy(pose_graph.poses)
    priors = turned(priors, poses)
    free, scale = free_directions(priors, poses)
    if not free.shape[1]:
        return priors
    first = lie.take(poses, np.zeros(1, int))
    left = np.asarray(lie.adjoint(_about_middle(first, priors, poses)))[0]
    rows = free.T @ (scale[:, None] * left)
    sure = SURE * _typical(pose_graph, priors)
    hold = Priors(
        np.zeros(1, np.int32), first, sure * (rows.T @ rows)[None], np.array([""], object)
    )
    return Priors.concatenate([priors, hold])


def _typical(pose_graph: PoseGraph, priors: Priors) -> float:
    information = np.asarray(pose_graph.information)
    information = information if len(information) else priors.information
    space = lie.module_of(pose_graph.group).MATRIX_DIM - 1
    return (
        float(np.median(np.trace(information[:, :space, :space], axis1=1, axis2=2)) / space) or 1.0
    )


def freedom_added(pose_graph: PoseGraph) -> int:
    """Rows less columns that priors bring, beside a map whose first pose is held."""
    priors = priors_of(pose_graph)
    if priors is None:
        return 0
    free, _ = free_directions(turned(priors, pose_graph.poses), pose_graph.poses)
    rank = np.linalg.matrix_rank(priors.information, hermitian=True).sum()
    return int(rank) - (pose_graph.tangent_dim - free.shape[1])
