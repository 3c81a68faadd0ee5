"""`MapCovariance`: how certain a map's poses are, factorised once and asked many times.

With `H = Σ JᵀJ` at the optimum and the first pose held, the joint covariance of the poses that
closures touch is a block of `H⁻¹`, found from the sparse factor `H = L Lᵀ` by forward substitution:

    Σ_right = Wᵀ W,  W = L⁻¹ E              right perturbations X exp(δ)
    Σ_left  = Wᵀ W,  W = L⁻¹ E Ad(X)ᵀ       left perturbations exp(ξ) X: ξ = Ad(X) δ

with `E` the unit columns of the poses asked for: never the whole inverse, never pose pair by pose
pair. A map with priors has no pose held: their `JᵀJ` is in H, see `mapping.priors`. Left
perturbations are those of the map moved so that `origin` is at zero: far from it their
covariances cancel where they are subtracted. Runs on the host.
"""

from __future__ import annotations

import dataclasses
import functools
import threading
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import as_array, on_host
from pcm_jax.errors import InputError, check_class
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping._odometry import check_steps, odometry_steps
from pcm_jax.mapping._pair_covariances import pair_covariances
from pcm_jax.mapping.covariance_factor import covariance_factor
from pcm_jax.mapping.priors import priors_of
from pcm_jax.sparse.cholesky import CholeskyFactor
from pcm_jax.sparse.inverse import (
    inverse_block,
    inverse_column,
    inverse_columns,
    inverse_diagonal,
    inverse_own,
)
from pcm_jax.sparse.selected import Selected

SIDES = ("right", "left")
MANY_POSES = 512
"""Poses from which one pass over the whole factor takes less than theirs (`Selected`)."""
LOOPS_SINCE = 5
"""Loops that a factor of before serves for (`first_order`): more take longer than a new one."""


class MapCovariance:
    """The covariance of a map's poses at the graph's own poses, which should be the optimum.

    The map is factorised when it is first asked, and never again, whichever thread asks. The first
    pose is held: certain, and tied to none. In a map with priors it is as uncertain as they leave
    it, and in directions that they leave free it is held.

        covariance = pcm_jax.MapCovariance(pcm_jax.optimize(pose_graph).graph)
        covariance.joint([3, 17])  # [2 d, 2 d]

    Args:
        pose_graph: an optimised map.
        origin: float64 `[s]`, s = 2 or 3, metres: the point about which left perturbations turn.
            None: the mean position of all poses. Give a map that has grown the origin that it had,
            so that covariances of before and after are in one frame.

    Attributes:
        pose_graph: as given.
        origin: as above; whoever asks for which poses, it does not move.
    """

    def __init__(self, pose_graph: PoseGraph, *, origin: Float[np.ndarray, " s"] | None = None):
        check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
        self.pose_graph = pose_graph
        self._poses = lie.as_numpy(pose_graph.poses)
        positions = lie.translation(self._poses)
        self.origin = np.array(positions.mean(axis=0) if origin is None else origin, np.float64)
        if self.origin.shape != positions.shape[1:]:
            raise InputError(
                f"origin: shape {self.origin.shape} given, expected {positions.shape[1:]}"
            )
        self._lock = threading.Lock()
        self._factor: CholeskyFactor | None = None
        self._trunk: MapCovariance = self
        self._past: MapCovariance = self
        self._summed: Float[np.ndarray, "g d d"] = np.zeros((0, self._dim, self._dim))
        self._held = 0 if priors_of(pose_graph) is None else pose_graph.num_poses

    def __reduce__(self) -> Any:
        return functools.partial(MapCovariance, origin=self.origin), (self.pose_graph,)

    def __repr__(self) -> str:
        at = ", ".join(f"{value:.4g}" for value in self.origin)
        return f"MapCovariance({self.pose_graph!r}, about ({at}) m)"

    @functools.cached_property
    def frame(self) -> Any:
        """The poses, Lie `[n]`, NumPy, in the frame of left perturbations: `origin` at zero."""
        values = np.array(lie.parameters(self._poses))
        values[:, -len(self.origin) :] -= self.origin
        return lie.group_of(self._poses)(values)

    @functools.cached_property
    def adjoint(self) -> Float[np.ndarray, "n d d"]:
        """Ad of every pose of `frame`: right perturbations to left ones."""
        return np.asarray(lie.adjoint(self.frame))

    @on_host
    def joint(
        self, poses: Int[np.ndarray, " k"], *, side: str = "right"
    ) -> Float[np.ndarray, "k*d k*d"]:
        """The joint covariance of some poses.

        Args:
            poses: `[k]` indices, in any order, each once.
            side: "right" for perturbations `X exp(δ)`, "left" for `exp(ξ) X` of the poses in
                `frame`; both are (translation, rotation), metres and radians.

        Returns:
            `[k·d, k·d]`, blocks in the order of `poses`; zero where the first pose is concerned,
            if it is held.

        Raises:
            InputError: for an index out of range or given twice, another `side`, a singular map.
        """
        wanted, d = self._checked(poses, side), self.pose_graph.tangent_dim
        free = np.flatnonzero(wanted != self._held)
        covariance = np.zeros((len(wanted), d, len(wanted), d))
        if len(free):
            found = inverse_block(self.factor(), wanted[free], self._right(wanted[free], side))
            scalar, shape = np.arange(d), (len(free), d, len(free), d)
            covariance[np.ix_(free, scalar, free, scalar)] = found.reshape(shape)
        return covariance.reshape(len(wanted) * d, len(wanted) * d)

    @on_host
    def diagonal(
        self, poses: Int[np.ndarray, " k"] | None = None, *, side: str = "right"
    ) -> Float[np.ndarray, "k d d"]:
        """Each pose's own covariance; None: all poses, in their order. See `joint`."""
        everyone = np.arange(self.pose_graph.num_poses)
        wanted, d = self._checked(everyone if poses is None else poses, side), self._dim
        free = np.flatnonzero(wanted != self._held)
        covariance = np.zeros((len(wanted), d, d))
        if len(free):
            right = self._right(wanted[free], side)
            covariance[free] = self._own_blocks(wanted[free], right)
        return covariance

    def _own_blocks(self, poses: np.ndarray, right: np.ndarray | None) -> np.ndarray:
        if len(poses) < MANY_POSES:
            return inverse_diagonal(self.factor(), poses, right)
        blocks = Selected(self.factor()).pairs(poses, poses)
        return blocks if right is None else right.swapaxes(1, 2) @ blocks @ right

    @on_host
    def pairs(
        self, first: Int[np.ndarray, " k"], second: Int[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k 2*d 2*d"]:
        """The joint covariance of two poses, for each of many pairs; right perturbations.

        Pairs that edges of the map join take together about what a factorisation takes; the others
        are found in the joint covariances of some poses at a time.

            covariance.pairs(graph.tail, graph.head)

        Args:
            first, second: `[k]` indices; a pose may occur in any number of pairs.

        Returns:
            `[k, 2 d, 2 d]`; zero where the first pose of the map is concerned, if it is held.

        Raises:
            InputError: as `joint`; for a pair of one pose with itself.
        """
        size = self.pose_graph.num_poses
        given = (("first", first), ("second", second))
        ends = [_check_indices(as_array(poses, name), size, name) for name, poses in given]
        if len(ends[0]) != len(ends[1]):
            raise InputError(
                f"second: {len(ends[1])} poses given, expected {len(ends[0])} as in first"
            )
        tail, head = ends
        if (tail == head).any():
            at = int(np.argmax(tail == head))
            raise InputError(f"second[{at}]: {head[at]} given, expected another pose than first's")
        return pair_covariances(self, self._held, tail, head)

    @on_host
    def columns(self, poses: Int[np.ndarray, " c"], *, side: str = "right") -> CovarianceColumns:
        """The covariance of all poses with some, of which `CovarianceColumns.rows` gives parts.

        For where `joint` would be too large: n times c blocks, and the work of c solves.

        Args:
            poses: `[c]` indices, each once.
            side: of the perturbations of `poses`, as in `joint`.

        Raises:
            InputError: as `joint`.
        """
        wanted = self._checked(poses, side)
        right = self._right(wanted, side)
        right = np.eye(self._dim) + np.zeros((len(wanted), 1, 1)) if right is None else right
        right = right * (wanted != self._held)[:, None, None]
        factor = self.factor()
        solution = inverse_columns(factor, wanted, right)
        return CovarianceColumns(self.adjoint, factor.plan.position, solution)

    def column(self, pose: int, others: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k d d"]:
        """The covariance of some poses with one, left perturbations of `frame`.

        One solve, and in a map that has grown by its odometry (`extend`) that of the map before.

        Args:
            pose: an index.
            others: `[k]` indices, not checked.

        Returns:
            `[j]` is Cov(ξ of `others[j]`, ξ of `pose`).
        """
        trunk = self._trunk
        last = trunk.pose_graph.num_poses - 1
        anchor, reached = min(pose, last), np.minimum(others, last)
        if anchor == trunk._held:
            found = np.zeros((len(others), self._dim, self._dim))
        else:
            factor = trunk.factor()
            solved = inverse_column(factor, anchor, trunk.adjoint[anchor].T)
            found = trunk.adjoint[reached] @ solved[factor.plan.position[reached]]
            found[reached == trunk._held] = 0.0
        if pose > last:
            shared = np.minimum(others, pose) - last
            beyond = shared > 0
            found[beyond] += self._grown()[shared[beyond] - 1]
        return found

    def own(self, pose: int) -> Float[np.ndarray, "d d"]:
        """The covariance of one pose, left perturbations of `frame`: as `column` of it has it.

        Args:
            pose: an index, not checked.
        """
        trunk = self._trunk
        last = trunk.pose_graph.num_poses - 1
        anchor, found = min(pose, last), np.zeros((self._dim, self._dim))
        if anchor != trunk._held:
            found = inverse_own(trunk.factor(), anchor, trunk.adjoint[anchor].T)
        return found if pose <= last else found + self._grown()[pose - last - 1]

    def extend(self, pose_graph: PoseGraph) -> MapCovariance:
        """The covariance of a map that has grown by steps of odometry from its last pose on.

        A pose that one edge alone joins to the map changes no other: with X exp(δ) measured from
        the pose before, ξ = ξ_before + Ad(X) δ. So `column` needs no new factorisation; whatever
        else is asked makes one.

            grown = covariance.extend(longer)   # longer.poses[:n] are the poses of before

        Args:
            pose_graph: the map, with edges (n − 1, n), (n, n + 1), …, behind those it had, and the
                new poses where these put them.

        Raises:
            InputError: for another map than that: `MapCovariance` then starts anew.
        """
        check_steps(self.pose_graph, pose_graph)
        grown = MapCovariance(pose_graph, origin=self.origin)
        grown._trunk, grown._summed = self._trunk, self._summed
        return grown

    def followed_by(self, pose_graph: PoseGraph) -> MapCovariance:
        """The covariance of the map at another optimum, with the edges it had and some behind."""
        after, known = MapCovariance(pose_graph, origin=self.origin), self.known
        before = known.pose_graph
        poses, edges = after.pose_graph.num_poses, after.pose_graph.num_edges
        if edges - before.num_edges - (poses - before.num_poses) < LOOPS_SINCE:
            after._past = known
        return after

    @property
    def known(self) -> MapCovariance:
        """The covariance that this map's next one follows to first order.

        What it was extended from (`extend`) if that is factorised, or follows none that is; else
        the last one before that was, of up to `LOOPS_SINCE` loops ago.
        """
        return self._trunk._past

    def _grown(self) -> Float[np.ndarray, "g d d"]:
        """Sums of the steps since the trunk, left perturbations; computed when first asked."""
        trunk, known = self._trunk.pose_graph, self._summed
        if len(known) < self.pose_graph.num_poses - trunk.num_poses:
            first = trunk.num_poses + len(known), trunk.num_edges + len(known)
            steps = odometry_steps(self.pose_graph, *first, self.origin)
            steps[0] += known[-1] if len(known) else 0.0
            self._summed = np.concatenate([known, np.cumsum(steps, axis=0)])
        return self._summed

    def renamed(self, name: str) -> MapCovariance:
        """The same of a robot that is called otherwise; what is known of it is shared."""
        twin = object.__new__(MapCovariance)
        own = {name: twin for name in ("_trunk", "_past") if getattr(self, name) is self}
        renamed = dataclasses.replace(self.pose_graph, name=name)
        twin.__dict__ |= self.__dict__ | own | {"pose_graph": renamed}
        return twin

    def factor(self) -> CholeskyFactor:
        """The factor of H; see `covariance_factor`."""
        with self._lock:
            if self._factor is None:
                self._factor = covariance_factor(self.pose_graph)
                self._past = self  # a factor of its own is nearer, and the other memory
            return self._factor

    @property
    def _dim(self) -> int:
        return self.pose_graph.tangent_dim

    def _checked(self, poses: Any, side: str) -> Int[np.ndarray, " k"]:
        if side not in SIDES:
            raise InputError(f"side: {side!r} given, expected one of {', '.join(SIDES)}")
        return _check_once(_check_indices(as_array(poses, "poses"), self.pose_graph.num_poses))

    def _right(self, poses: np.ndarray, side: str) -> Float[np.ndarray, "k d d"] | None:
        """Right-hand sides: Ad(X)ᵀ for left perturbations, identities (None) for right ones."""
        return None if side == "right" else self.adjoint[poses].swapaxes(1, 2)


class CovarianceColumns(NamedTuple):
    """The covariance of all poses' perturbations with those of c poses, from `columns`.

    Attributes:
        adjoint: `[n, d, d]`, of each pose.
        position: `[n]`, where each pose's block lies.
        blocks: `[n, d, d, c]`, rows are right perturbations.
    """

    adjoint: Float[np.ndarray, "n d d"]
    position: Int[np.ndarray, " n"]
    blocks: Float[np.ndarray, "n d d c"]

    def rows(
        self, poses: Int[np.ndarray, " r"], *, side: str = "right"
    ) -> Float[np.ndarray, "r d d c"]:
        """The blocks of some poses, by their right or left perturbations."""
        right = self.blocks[self.position[poses]]
        if side == "right":
            return right
        d = right.shape[1]
        return (self.adjoint[poses] @ right.reshape(len(right), d, -1)).reshape(right.shape)


def joint_marginal_covariance(
    pose_graph: PoseGraph, poses: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "k*d k*d"]:
    """The joint covariance of some poses at the graph's own poses, which should be the optimum.

    For one question; `MapCovariance` answers many by one factorisation.

    Args:
        pose_graph: an optimised map.
        poses: `[k]` indices, in any order, each once. The first pose is held, so its rows and
            columns are zero.

    Returns:
        `[k·d, k·d]` for right perturbations `X exp(δ)`, δ = (translation, rotation), metres and
        radians; blocks in the order of `poses`.

    Raises:
        InputError: for an index out of range or given twice, or a singular map.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    return MapCovariance(pose_graph).joint(poses)


def _check_indices(poses: np.ndarray, size: int, name: str = "poses") -> np.ndarray:
    if poses.ndim != 1 or not np.issubdtype(poses.dtype, np.integer):
        raise InputError(
            f"{name}: shape {poses.shape}, dtype {poses.dtype} given, expected integers [k]"
        )
    outside = np.flatnonzero((poses < 0) | (poses >= size))
    if len(outside):
        at = outside[0]
        raise InputError(f"{name}[{at}]: {poses[at]} given, expected 0 … {size - 1}")
    return poses.astype(np.int64)


def _check_once(poses: np.ndarray) -> np.ndarray:
    values, count = np.unique(poses, return_counts=True)
    if (count > 1).any():
        raise InputError(f"poses: {values[count > 1][0]} given twice, expected each pose once")
    return poses
