"""To and from GTSAM's factor graphs and values, in memory.

GTSAM's `Pose3` puts rotation first in its tangent, `Pose2` is (x, y, θ) like ours; both perturb on
the right. GTSAM is no dependency: whoever has such graphs has it.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import InputError, InputWarning, check_class
from pcm_jax.files.assembly import graph_of
from pcm_jax.files.formats.g2o import check_group, closure_keys, original_keys
from pcm_jax.files.pose_file import Lines, PoseFile, Reading
from pcm_jax.files.scopes import Scope, made_scope
from pcm_jax.graph import symbols
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.pose_graph import PoseGraph
from pcm_jax.graph.priors import Priors
from pcm_jax.graph.validation import Fault, argument_fault, check_information, check_self_loops


class _Kind(NamedTuple):
    """GTSAM's own for a group: a pose from a matrix, factors, and our tangent's entries."""

    group: type[Any]
    pose: Callable[[Any], Any]
    between: Any
    prior: Any
    order: list[int]


def to_gtsam(graph: MultiRobotGraph | PoseGraph) -> tuple[Any, Any]:
    """A graph as GTSAM's `NonlinearFactorGraph` and `Values`.

    Keys are those that `write_g2o` writes: one robot's ids as they are, several robots' as symbols
    that name the robot by letter. There is no prior but the maps' own: GTSAM's optimisers want one
    on some pose.

    Args:
        graph: SE(2) or SE(3).

    Returns:
        between factors, the maps' edges robot by robot and then the closures, with Gaussian noise
        of their information; after each robot's edges its priors; and the poses.

    Raises:
        InputError: without GTSAM, for another group, and for ids that fit no key.
    """
    check_class("graph", graph, "a MultiRobotGraph or PoseGraph", MultiRobotGraph, PoseGraph)
    gtsam = _gtsam()
    if isinstance(graph, PoseGraph):
        graph = MultiRobotGraph((graph,))
    check_group(graph)
    (kind,) = (each for each in _kinds(gtsam) if each.group is graph.group)
    keys = original_keys(graph.maps)[1]
    values, factors = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for pose_graph, ids in zip(graph.maps, keys, strict=True):
        for key, matrix in zip(ids.tolist(), _matrices(pose_graph.poses), strict=True):
            values.insert(key, kind.pose(matrix))
        ends = ids[np.asarray(pose_graph.tail)], ids[np.asarray(pose_graph.head)]
        _add(factors, gtsam, kind, ends, pose_graph)
        if pose_graph.priors is not None:
            _add_priors(factors, gtsam, kind, ids, pose_graph.priors)
    _add(factors, gtsam, kind, closure_keys(graph, keys), graph.closures)
    return factors, values


def from_gtsam(
    factors: Any, values: Any, *, constrained_sigma: float | None = None
) -> MultiRobotGraph:
    """Maps and closures from GTSAM's `NonlinearFactorGraph` and `Values`.

    As `read_graph` takes a g2o file: symbol keys name their robots by letter, between factors that
    join two robots are closures, and poses come in the order of their keys. Keys that are no
    symbols belong to one robot.

    Args:
        factors: between factors of `Pose2` or `Pose3`, and priors on poses. Others are left out.
        values: a pose for every key.
        constrained_sigma: what to take for a standard deviation of 0 (metres, radians; 1e-6, say).
            None makes such hard constraints an error.

    Returns:
        the graph; `source` of edges and closures is "factors:INDEX".

    Raises:
        InputError: without GTSAM; naming the factor, for one without a Gaussian noise model, with a
            key that has no pose, or with information that is not positive definite; for a map that
            is not connected.

    Warns:
        InputWarning: for factors left out, counted by type.
    """
    gtsam = _gtsam()
    check_class("factors", factors, "a NonlinearFactorGraph", gtsam.NonlinearFactorGraph)
    check_class("values", values, "GTSAM's Values", gtsam.Values)
    chosen = [(index, factors.at(index)) for index in range(factors.size())]
    chosen = [(index, factor) for index, factor in chosen if factor is not None]
    for kind in _kinds(gtsam):
        edges = [(index, each) for index, each in chosen if isinstance(each, kind.between)]
        if edges:
            break
    else:
        raise InputError("factors: no BetweenFactorPose2 or BetweenFactorPose3 among them")
    alone = [(index, each) for index, each in chosen if isinstance(each, kind.prior)]
    left_out = Counter(
        type(each).__name__ for _, each in chosen if not isinstance(each, kind.between | kind.prior)
    )
    poses = [(key, pose) for key in list(values.keys()) if (pose := _pose(values, key, kind))]
    vertices = _lines([[key] for key, _ in poses], [pose for _, pose in poses], kind)
    found = PoseFile(
        "factors",
        kind.group,
        vertices,
        _edges(edges, gtsam, kind, constrained_sigma),
        format="gtsam",
        left_out=left_out,
        priors=_edges(alone, gtsam, kind, constrained_sigma) if alone else None,
    )
    found = dataclasses.replace(found, scope=_scope(found))
    graph, account = graph_of([found], Reading())
    for line in account.warnings():
        warnings.warn(InputWarning(line), stacklevel=2)
    return graph


def _scope(found: PoseFile) -> Scope | None:
    """One nameless robot where keys are no symbols."""
    keyed = symbols.are_symbols(found.ids) or symbols.are_labelled(found.ids)
    return None if keyed else made_scope(["factors"], [""], kind="one", rule="plain keys")


def _gtsam() -> ModuleType:
    try:
        import gtsam  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("gtsam: not installed, expected it: pip install gtsam") from None
    return gtsam


def _kinds(gtsam: Any) -> tuple[_Kind, _Kind]:
    def pose2(matrix: Any) -> Any:
        return gtsam.Pose2(gtsam.Rot2.fromCosSin(*matrix[:2, 0]), matrix[:2, 2])

    return (
        _Kind(jaxlie.SE2, pose2, gtsam.BetweenFactorPose2, gtsam.PriorFactorPose2, [0, 1, 2]),
        _Kind(
            jaxlie.SE3,
            gtsam.Pose3,
            gtsam.BetweenFactorPose3,
            gtsam.PriorFactorPose3,
            [3, 4, 5, 0, 1, 2],
        ),
    )


def _matrices(transforms: Any) -> np.ndarray:
    return np.asarray(lie.as_matrix(lie.as_numpy(transforms)))


def _add(factors: Any, gtsam: Any, kind: _Kind, keys: Sequence[np.ndarray], measured: Any) -> None:
    """Between factors of the measurements and information of edges or closures."""
    order = np.array(kind.order)  # its own inverse
    information = np.asarray(measured.information)[:, order[:, None], order]
    ends = keys[0].tolist(), keys[1].tolist()
    for tail, head, matrix, weight in zip(
        *ends, _matrices(measured.measurement), information, strict=True
    ):
        noise = gtsam.noiseModel.Gaussian.Information(weight)
        factors.add(kind.between(tail, head, kind.pose(matrix), noise))


def _add_priors(factors: Any, gtsam: Any, kind: _Kind, ids: np.ndarray, priors: Priors) -> None:
    """Prior factors, whose information may lack directions."""
    order = np.array(kind.order)
    values, vectors = np.linalg.eigh(priors.information[:, order[:, None], order])
    roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.swapaxes(1, 2)
    keys = ids[priors.pose].tolist()
    for key, matrix, root in zip(keys, _matrices(priors.measurement), roots, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)
        factors.add(kind.prior(key, kind.pose(matrix), noise))


def _pose(values: Any, key: int, kind: _Kind) -> Any:
    """The pose of a key, None where its value is none of this kind."""
    try:
        return values.atPose2(key) if kind.group is jaxlie.SE2 else values.atPose3(key)
    except (RuntimeError, ValueError, TypeError):
        return None


def _lines(keys: list[list[int]], poses: list[Any], kind: _Kind) -> Lines:
    size = lie.module_of(kind.group).MATRIX_DIM
    matrices: Any = np.array([pose.matrix() for pose in poses]).reshape(-1, size, size)
    d = lie.tangent_dim(kind.group)
    return Lines(
        ids=np.array(keys, np.int64).reshape(len(poses), -1),
        transforms=np.asarray(lie.parameters(lie.from_matrix(matrices))),
        information=np.zeros((len(poses), d, d)),
        line=np.arange(len(poses)),
    )


def _edges(
    edges: list[tuple[int, Any]], gtsam: Any, kind: _Kind, constrained: float | None
) -> Lines:
    """The between factors, or the priors, checked."""
    index = np.array([number for number, _ in edges])
    lines = _lines([f.keys() for _, f in edges], [_measured(f) for _, f in edges], kind)

    def fault(row: int, problem: str) -> InputError:
        return argument_fault("factors")(int(index[row]), problem)

    weights = []
    for row, (_, factor) in enumerate(edges):
        noise = factor.noiseModel()
        if not isinstance(noise, gtsam.noiseModel.Gaussian):
            name = type(noise).__name__
            wrapped = " (its .noise())" * hasattr(noise, "noise")
            raise fault(row, f"noise model {name}, expected a Gaussian one{wrapped}")
        weights.append(_information(noise, gtsam, constrained, row, fault))
    order = np.array(kind.order)
    information = check_information(
        np.array(weights)[:, order[:, None], order], fault, singular=True
    )
    if lines.ids.shape[1] == 2:
        check_self_loops(lines.ids[:, 0], lines.ids[:, 1], fault)
        inner = np.flatnonzero(_inside(lines.ids))
        check_information(information[inner], lambda row, text: fault(int(inner[row]), text))
    return dataclasses.replace(lines, information=information, line=index)


def _inside(ids: np.ndarray) -> np.ndarray:
    """Marks the edges `[k]` of one robot's own map, whose information may not lack directions."""
    labels, letters = symbols.labels_of(ids), symbols.letters_of(ids)
    codes = np.where(labels > 0, labels, letters)
    return codes[:, 0] == codes[:, 1]


def _measured(factor: Any) -> Any:
    """The measurement of a between factor or a prior."""
    return factor.measured() if hasattr(factor, "measured") else factor.prior()


def _information(
    noise: Any, gtsam: Any, constrained: float | None, row: int, fault: Fault
) -> np.ndarray:
    """A Gaussian noise model's information; hard constraints get the sigma given for them."""
    if not isinstance(noise, gtsam.noiseModel.Constrained):
        return noise.information()
    sigmas = np.array(noise.sigmas())
    if (sigmas <= 0.0).any():
        if constrained is None:
            raise fault(
                row,
                "a hard constraint (sigma 0), expected a Gaussian noise model;"
                " constrained_sigma=1e-6 would take it for a very sure measurement",
            )
        sigmas = np.where(sigmas <= 0.0, constrained, sigmas)
    return np.diag(sigmas**-2.0)
