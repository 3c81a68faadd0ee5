"""A certificate that a solution lies where no other poses fit better: the dual of SE-Sync.

With one precision τ of translation and κ of rotation for each edge, and rotations' errors measured
by chords, the cost of a map is quadratic in its poses' matrices,

    F = Σ κ |R_j − R_i R̃|² + τ |t_j − t_i − R_i t̃|² = tr(Xᵀ M X),     X_i = (t_iᵀ; R_iᵀ),

which for small errors is Σ rᵀΩr where Ω is isotropic. With Λ_i = sym((M X)_Rᵢ R_i), the
multipliers of R_iᵀR_i = I, and S = M − diag(0, Λ), any poses Y cost tr(Yᵀ S Y) + tr Λ. So if
S + η E is positive definite, E the identity on rotations, none of n poses in s dimensions cost less
than

    tr Λ − η s n,

and F at X is within F − tr Λ + η s n of the least: a proof that needs neither a start nor luck. S
is positive semidefinite only where X is stationary, so the solution is first moved to a minimum of
F. Whether it is definite, one sparse Cholesky factorisation says. S has a null direction, the map's
own position; a term that holds the first pose's changes nothing of this.

D. M. Rosen, L. Carlone, A. S. Bandeira and J. J. Leonard, "SE-Sync: a certifiably correct algorithm
for synchronization over the special Euclidean group", IJRR 2019; D. M. Rosen, "Accelerating
certifiable estimation with preconditioned eigensolvers", RA-L 2022.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jaxlie
import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.errors import InputError
from pcm_jax.graph import PoseGraph
from pcm_jax.mapping.priors import priors_of
from pcm_jax.sparse.cholesky import NotPositiveDefiniteError
from pcm_jax.sparse.system import system_for

GAP = 1e-3
"""Of F, or of 1 where F is less: what may remain between F and its lower bound."""
LEAST = 1e-13
"""Of the mean diagonal of M: the η that is tried first; ten times it next."""
STEPS = 50
SETTLED = 1e-11  # metres, radians


@dataclass(frozen=True, repr=False)
class Certificate:
    """The proof that no poses fit better than a solution's, or that none was found.

    It is about the isotropic chordal cost of the same map (half of F, see the module), whose
    minimum nearest to the solution is meant, and says nothing of by how much the two costs differ
    where noise is large or far from isotropic: a solution that is certified lies in the basin of
    the global minimum; one that is not may be a local one, or the noise too large for the proof.

    Attributes:
        certified: whether no poses cost less than `cost` by more than a thousandth.
        cost: half of F at its minimum nearest to the solution.
        lower_bound: no poses cost less; −∞ where none was proven.
        moved: metres and radians by which that minimum differs from the solution, at most.
    """

    certified: bool
    cost: float
    lower_bound: float
    moved: tuple[float, float]

    def __repr__(self) -> str:
        metres, radians = self.moved
        return (
            f"Certificate({'certified' if self.certified else 'not certified'})\n"
            f"  cost   {self.cost:.6g}, of any poses at least {self.lower_bound:.6g}\n"
            f"  moved  {metres:.3g} m, {radians:.3g} rad from the solution"
        )


@on_host
def certify(pose_graph: PoseGraph) -> Certificate:
    """Proves that the poses of a map lie at its global minimum, if they do.

        solution = pcm_jax.optimize(graph.maps[0])
        solution.certificate

    Args:
        pose_graph: a connected map at its optimum.

    Raises:
        InputError: for a map with priors.
    """
    if priors_of(pose_graph) is not None:
        raise InputError(f"map {pose_graph.name!r}: it has priors, expected edges alone")
    if pose_graph.num_edges == 0:
        return Certificate(True, 0.0, 0.0, (0.0, 0.0))
    problem = _Problem.of(pose_graph)
    start = np.asarray(lie.as_matrix(lie.as_numpy(pose_graph.poses)), np.float64)
    poses = problem.minimum(start)
    cost = problem.cost(poses)
    bound = problem.lower_bound(poses)
    far = np.abs(poses - start)[:, :-1]
    turned = np.linalg.norm(far[:, :, :-1], axis=(1, 2)) / math.sqrt(2.0)
    moved = float(np.linalg.norm(far[:, :, -1], axis=1).max()), float(turned.max())
    certified = cost - bound <= GAP * max(cost, 1.0)
    return Certificate(bool(certified), 0.5 * cost, 0.5 * bound, moved)


class _Problem(NamedTuple):
    """F of a map.

    Attributes:
        tail, head: `[e]`.
        turn: R̃, `[e, s, s]`.
        shift: t̃, `[e, s]`.
        kappa, tau: `[e]`.
        count: poses.
    """

    tail: Int[np.ndarray, " e"]
    head: Int[np.ndarray, " e"]
    turn: Float[np.ndarray, "e s s"]
    shift: Float[np.ndarray, "e s"]
    kappa: Float[np.ndarray, " e"]
    tau: Float[np.ndarray, " e"]
    count: int

    @classmethod
    def of(cls, graph: PoseGraph) -> _Problem:
        """τ and κ of the mean variances: |R − I|² is twice the squared angle."""
        measured = np.asarray(lie.as_matrix(lie.as_numpy(graph.measurement)), np.float64)
        space = measured.shape[1] - 1
        variance = np.diagonal(np.linalg.inv(np.asarray(graph.information)), axis1=1, axis2=2)
        return cls(
            np.asarray(graph.tail, np.int64),
            np.asarray(graph.head, np.int64),
            measured[:, :space, :space],
            measured[:, :space, space],
            0.5 / variance[:, space:].mean(axis=1),
            1.0 / variance[:, :space].mean(axis=1),
            graph.num_poses,
        )

    def cost(self, poses: Float[np.ndarray, "n s+1 s+1"]) -> float:
        """F."""
        turned, shifted = self._residuals(*self._between(poses))
        squared = self.kappa * (turned**2).sum(axis=(1, 2)) + self.tau * (shifted**2).sum(axis=1)
        return float(squared.sum())

    def minimum(self, poses: Float[np.ndarray, "n s+1 s+1"]) -> Float[np.ndarray, "n s+1 s+1"]:
        """The minimum that Gauss-Newton reaches; steps that cost more are halved."""
        cost = self.cost(poses)
        for _ in range(STEPS):
            step = self._step(poses)
            for _ in range(STEPS):
                candidate = poses @ _exp(step, poses.shape[1] - 1)
                moved = self.cost(candidate)
                if moved <= cost or np.abs(step).max() <= SETTLED:
                    break
                step = 0.5 * step
            if not moved <= cost:
                return poses
            poses, cost = candidate, moved
            if np.abs(step).max() <= SETTLED:
                break
        return poses

    def lower_bound(self, poses: Float[np.ndarray, "n s+1 s+1"]) -> float:
        """Tr Λ − η s n, of the smallest η tried for which S + η E is definite; else −∞."""
        space = poses.shape[1] - 1
        rows = np.concatenate([poses[:, :space, space:], poses[:, :space, :space]], axis=2)
        rows = rows.transpose(0, 2, 1)  # X: t above Rᵀ
        products = self._quadratic()
        image = self._image(products, rows)[:, 1:]
        multipliers = image @ rows[:, 1:].transpose(0, 2, 1)
        multipliers = 0.5 * (multipliers + multipliers.transpose(0, 2, 1))
        trace = float(np.trace(multipliers, axis1=1, axis2=2).sum())
        own = np.zeros((self.count, space + 1, space + 1))
        own[:, 1:, 1:] = -multipliers
        own[0, 0, 0] += self.tau[(self.tail == 0) | (self.head == 0)].sum()
        size = np.diagonal(products[:2], axis1=2, axis2=3)[..., 1:].sum() / (space * self.count)
        widest = GAP * max(self.cost(poses), 1.0) / (space * self.count)
        eta = min(LEAST * size, widest)
        while eta <= widest:
            if self._is_definite(products, own + eta * np.diag([0.0, *np.ones(space)])):
                return trace - eta * space * self.count
            eta *= 10.0
        return -math.inf

    def _between(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R_iᵀ R_j and R_iᵀ (t_j − t_i)."""
        space = poses.shape[1] - 1
        back = poses[self.tail, :space, :space].transpose(0, 2, 1)
        apart = poses[self.head, :space, space] - poses[self.tail, :space, space]
        return back @ poses[self.head, :space, :space], np.einsum("eij,ej->ei", back, apart)

    def _residuals(self, turn: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return turn - self.turn, shift - self.shift

    def _step(self, poses: np.ndarray) -> Float[np.ndarray, "n d"]:
        """Gauss-Newton's, for right perturbations; zero where there is no factor."""
        turn, shift = self._between(poses)
        space = shift.shape[1]
        turned, shifted = self._residuals(turn, shift)
        basis = _generators(space)
        count, d = len(shift), space + len(basis)
        by_tail, by_head = (np.zeros((count, space * space + space, d)) for _ in range(2))
        for axis, generator in enumerate(basis, start=space):
            by_tail[:, : space**2, axis] = -(generator @ turn).reshape(count, -1)
            by_head[:, : space**2, axis] = (turn @ generator).reshape(count, -1)
            by_tail[:, space**2 :, axis] = -shift @ generator.T
        by_tail[:, space**2 :, :space] = -np.eye(space)
        by_head[:, space**2 :, :space] = turn
        weight = np.sqrt(np.repeat([self.kappa, self.tau], [space**2, space], axis=0)).T
        residual = weight * np.concatenate([turned.reshape(count, -1), shifted], axis=1)
        by_tail, by_head = weight[..., None] * by_tail, weight[..., None] * by_head
        to_tail, to_head = by_tail.transpose(0, 2, 1), by_head.transpose(0, 2, 1)
        system = self._system(d, first_held=True)
        gradient = system.gradient(
            np.stack([(to @ residual[..., None])[..., 0] for to in (to_tail, to_head)])
        )
        products = np.stack([to_tail @ by_tail, to_head @ by_head, to_head @ by_tail])
        try:
            factor = system.factorize(products)
        except NotPositiveDefiniteError:
            return np.zeros((self.count, d))
        return -factor.solve(gradient.ravel()).reshape(gradient.shape)

    def _quadratic(self) -> Float[np.ndarray, "3 e s+1 s+1"]:
        """M's blocks by edges: of tails, of heads, of heads with tails."""
        count, space = self.shift.shape
        of_tail = np.zeros((count, space + 1, space + 1))
        of_tail[:, 0, 0], of_tail[:, 0, 1:] = 1.0, self.shift
        of_tail[:, 1:, 1:] = self.turn.transpose(0, 2, 1)
        weight = np.repeat([self.tau, self.kappa], [1, space], axis=0).T[..., None]
        to_tail, of_head = of_tail.transpose(0, 2, 1), np.eye(space + 1)
        return np.stack([to_tail @ (weight * of_tail), weight * of_head, -(weight * of_tail)])

    def _image(self, products: np.ndarray, rows: np.ndarray) -> Float[np.ndarray, "n s+1 s"]:
        """M X."""
        image = np.zeros_like(rows)
        tail, head = rows[self.tail], rows[self.head]
        across = products[2]
        np.add.at(image, self.tail, products[0] @ tail + across.transpose(0, 2, 1) @ head)
        np.add.at(image, self.head, products[1] @ head + across @ tail)
        return image

    def _is_definite(self, products: np.ndarray, own: np.ndarray) -> bool:
        """True where M with `own` added to its diagonal blocks is."""
        whole = products.copy()
        ends = np.concatenate([self.tail, self.head])
        first = np.unique(ends, return_index=True)[1]  # an edge that each pose ends
        side, edge = np.divmod(first, len(self.tail))
        np.add.at(whole, (side, edge), own)
        try:
            self._system(own.shape[1], first_held=False).factorize(whole)
        except NotPositiveDefiniteError:
            return False
        return True

    def _system(self, block_dim: int, *, first_held: bool) -> Any:
        held = (np.arange(self.count) == 0) & first_held
        return system_for(self.count, self.tail, self.head, held, block_dim)


def _generators(space: int) -> Float[np.ndarray, "k s s"]:
    """The rotations' generators."""
    if space == 2:
        return np.array([[[0.0, -1.0], [1.0, 0.0]]])
    levi = np.zeros((3, 3, 3))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        levi[k, j, i], levi[k, i, j] = 1.0, -1.0
    return levi


def _exp(step: Float[np.ndarray, "n d"], space: int) -> Float[np.ndarray, "n s+1 s+1"]:
    """Matrices of steps (translation, rotation), each by itself."""
    tangent: Any = np.zeros_like(step)
    tangent[:, space:] = step[:, space:]
    kind = jaxlie.SE2 if space == 2 else jaxlie.SE3
    matrices = np.array(lie.as_matrix(lie.exp(kind, tangent)), np.float64)
    matrices[:, :space, space] = step[:, :space]
    return matrices
