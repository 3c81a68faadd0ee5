"""`StackedClosures`: the errors of k closures about one common alignment, and their covariance.

Closure u alone puts map b in map a at `T_u = X_i z_u Y_k⁻¹` (poses in `MapCovariance.frame`). With
left perturbations ξ of map a's poses and η of map b's, δ_u the measurement's error, and W the
alignment common to all,

    e_u = Log(T_u W⁻¹) ≈ w + ξ_i + Ad(X_i z_u) δ_u − Ad(W) η_k
    K   = Σa + Ad(W) Σb Ad(W)ᵀ + blkdiag(Z_u),          Z_u = Ad(X_i z_u) Σ_zu Ad(X_i z_u)ᵀ
    χ²  = min over w of (e − H w)ᵀ K⁻¹ (e − H w),       H = k identities, one below the other

where w moves W to `exp(w) W`, and Σa, Σb are joint covariances, the blocks of a pose repeated for
each closure that touches it. Ad is taken of the common W throughout, so an error common to a whole
map is a multiple of H and cancels: χ² does not depend on the gauge. K is therefore formed of errors
less their mean over the closures, which loses no digits to what cancels, and W is the fixed point
of the weighted mean in that gauge. Host, NumPy, float64; (k d)² numbers.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.consistency.evidence import PairEvidence
from pcm_jax.consistency.limit import DIFFERENT
from pcm_jax.errors import InputError
from pcm_jax.graph import LoopClosures
from pcm_jax.graph.unsaid import noise_of
from pcm_jax.mapping import MapCovariance

ROUNDING = 1e-10
"""Of the largest eigenvalue of a closure's share of P: smaller ones are zero."""
STEPS, TOLERANCE = 20, 1e-8
"""Steps towards the common alignment, at most, and the last one's size in standard deviations."""


@dataclasses.dataclass(frozen=True, eq=False)
class StackedClosures:
    """The placements of k closures and the covariance of their errors, in the maps' frames.

    Attributes:
        placements: Lie `[k]`, NumPy, T_u.
        noise: `[k, d, d]`, Z_u.
        of_a: `[k, d, k, d]`, Σa: left perturbations of the pose in map a that each starts at.
        of_b: `[k, d, k, d]`, Σb: of the pose in map b that each ends at, in map b's frame.
        lever: how far from the middle of map b the closures end, metres.
        free: `[k, d, f]`, the directions that each leaves unsaid (`consistency.limit`), filled up
            with zeros; None where all is said.
    """

    placements: Any
    noise: Float[np.ndarray, "k d d"]
    of_a: Float[np.ndarray, "k d k d"]
    of_b: Float[np.ndarray, "k d k d"]
    lever: float
    free: Float[np.ndarray, "k d f"] | None = None

    def __len__(self) -> int:
        return len(self.noise)

    @property
    def dim(self) -> int:
        """d: 3 for SE(2), 6 for SE(3)."""
        return self.noise.shape[-1]

    def take(self, rows: Int[np.ndarray, " n"]) -> StackedClosures:
        """Some of the closures."""
        return StackedClosures(
            lie.take(self.placements, rows),
            self.noise[rows],
            _blocks(self.of_a, rows),
            _blocks(self.of_b, rows),
            self.lever,
            None if self.free is None else self.free[rows],
        )

    def errors(self, about: Any) -> Float[np.ndarray, "k d"]:
        """The errors e about an alignment, or about one alignment a closure."""
        return np.asarray(lie.log(lie.compose(self.placements, lie.inverse(about))))

    def covariance(self, about: Any, *, centred: bool = True) -> Float[np.ndarray, "k d k d"]:
        """The covariance K of the errors about an alignment.

        Args:
            about: Lie, W.
            centred: whether map errors are taken less their mean over the closures; else each map
                is held at its first pose.
        """
        adjoint = np.asarray(lie.adjoint(about))
        turned = (self.of_b @ adjoint.T).transpose(2, 3, 0, 1) @ adjoint.T
        total = self.of_a + turned.transpose(2, 3, 0, 1)
        if centred:
            total = total - total.mean(axis=0)
            total = total - total.mean(axis=2)[:, :, None]
        index = np.arange(len(self))
        total[index, :, index] += self.noise
        return total

    def fit(self) -> JointFit:
        """Finds the alignment that the closures have in common: the fixed point of its mean."""
        about = self._start()
        for _ in range(STEPS):
            found = fitted(self.errors(about), self.covariance(about), free=self.free)
            step = found.correction[0]
            if np.sum((found.design @ step) ** 2) < TOLERANCE**2:
                break
            about = lie.compose(_exp(about, step), about)
        return found._replace(alignment=about)

    def increases(
        self, members: Int[np.ndarray, " n"], others: Int[np.ndarray, " o"]
    ) -> Float[np.ndarray, " o"]:
        """The amount by which χ² of `members` rises if one of `others` joins them, for each.

        By the error that the others are predicted to have, given the members' errors and their
        alignment: χ² of n + 1 closures is that of n and that of the prediction's error.
        """
        self.check_all_said("increases")
        about = self.take(members).fit().alignment
        both, n, d = self.take(np.concatenate([members, others])), len(members), self.dim
        error, covariance = both.errors(about), both.covariance(about)
        fit = fitted(error[:n], covariance[:n, :, :n])
        cross = covariance[n:, :, :n].reshape(-1, n * d)
        gain = np.linalg.solve(fit.root.T, np.linalg.solve(fit.root, cross.T)).T
        index = np.arange(len(others))
        seen = np.tile(np.eye(d), (len(others), 1)) - gain @ np.tile(np.eye(d), (n, 1))
        off = error[n:].reshape(-1) - gain @ fit.error - seen @ fit.correction[0]
        off, seen = off.reshape(-1, d, 1), seen.reshape(-1, d, d)
        by_members = gain.reshape(-1, d, n * d) @ cross.reshape(-1, d, n * d).swapaxes(1, 2)
        own = covariance[n:, :, n:][index, :, index] - by_members
        own += seen @ fit.correction_covariance @ seen.swapaxes(1, 2)
        return np.sum(off * np.linalg.solve(own, off), axis=(1, 2))

    def check_all_said(self, what: str) -> None:
        """Raises `InputError` if some closures leave directions unsaid, which `what` cannot use."""
        if self.free is not None:
            lacking = int(self.free.any(axis=(1, 2)).sum())
            raise InputError(
                f"{what}: {lacking} of {len(self)} closures have singular information, expected"
                ' full rank (repair="clip" on reading gives it)'
            )

    def _start(self) -> Any:
        """The placement with the least sum of distances from the others: no mean of far ones."""
        shown = np.asarray(lie.as_matrix(self.placements))
        turned = self.lever * shown[:, :-1, :-1].reshape(len(shown), -1)
        features = np.concatenate([shown[:, :-1, -1], turned], axis=1)
        # |a − b|² = |a|² + |b|² − 2 a·b, about the first placement lest digits are lost
        features = features - features[0]
        lengths = (features**2).sum(axis=1)
        squared = lengths[:, None] + lengths - 2.0 * features @ features.T
        nearest = np.argmin(np.sqrt(np.maximum(squared, 0.0)).sum(axis=1))
        return lie.take(self.placements, int(nearest))


class JointFit(NamedTuple):
    """A common alignment, or several, fitted to closures; linear about `alignment`.

    Attributes:
        squared: χ².
        correction: `[alignments, d]`, w.
        correction_covariance: `[alignments·d, alignments·d]`, of w.
        error: `[k·d]`, e.
        root: `[k·d, k·d]`, L with K = L Lᵀ.
        design: `[k·d, alignments·d]`, L⁻¹ H.
        freedom: degrees of freedom of χ².
        alignment: Lie, W, where the fit was iterated.
        unsaid: `[k·d, s]`, an orthonormal basis of L⁻¹ N, which is left out of e and H; None
            where closures leave nothing unsaid.
        undetermined: `[alignments·d, n]`, directions of w that no closure says anything of; w is
            zero along them, and so is its covariance.
    """

    squared: float
    correction: Float[np.ndarray, "alignments d"]
    correction_covariance: Float[np.ndarray, "alignments*d alignments*d"]
    error: Float[np.ndarray, " k*d"]
    root: Float[np.ndarray, "k*d k*d"]
    design: Float[np.ndarray, "k*d alignments*d"]
    freedom: int
    alignment: Any = None
    unsaid: Float[np.ndarray, "k*d s"] | None = None
    undetermined: Float[np.ndarray, "alignments*d n"] | None = None

    def projection(self) -> Float[np.ndarray, "k d k d"]:
        """P = K⁻¹ − K⁻¹H (HᵀK⁻¹H)⁻¹ HᵀK⁻¹, with which χ² = eᵀ P e."""
        from scipy.linalg import solve_triangular

        size, d = len(self.error), self.correction.shape[1]
        inverse = solve_triangular(self.root, np.eye(size), lower=True)
        if self.unsaid is not None:
            inverse -= self.unsaid @ (self.unsaid.T @ inverse)
        seen = inverse.T @ self.design
        whole = inverse.T @ inverse - seen @ self.correction_covariance @ seen.T
        return whole.reshape(size // d, d, size // d, d)


def fitted(
    errors: Float[np.ndarray, "k d"],
    covariance: Float[np.ndarray, "k d k d"],
    group: Int[np.ndarray, " k"] | None = None,
    free: Float[np.ndarray, "k d f"] | None = None,
) -> JointFit:
    """Fits one alignment, or one for each group of closures, by generalised least squares.

    Args:
        errors: e.
        covariance: K.
        group: of each closure, 0 … ; None: all have one.
        free: directions that each closure leaves unsaid: K without bound along them.
    """
    from scipy.linalg import solve_triangular

    count, d = errors.shape
    group = np.zeros(count, int) if group is None else group
    groups = int(group.max()) + 1
    design = np.kron(group[:, None] == np.arange(groups), np.eye(d))
    root = np.linalg.cholesky(covariance.reshape(count * d, count * d))
    white = solve_triangular(root, np.column_stack([design, errors.reshape(-1)]), lower=True)
    design, error = white[:, :-1], white[:, -1]
    unsaid = undetermined = None
    if free is None:
        inverse = np.linalg.inv(design.T @ design)
    else:
        unsaid = _unsaid(root, free)
        before = design
        design = design - unsaid @ (unsaid.T @ design)
        error = error - unsaid @ (unsaid.T @ error)
        inverse, undetermined = _determined(before, design)
    correction = inverse @ (design.T @ error)
    left = error - design @ correction
    return JointFit(
        squared=float(left @ left),
        correction=correction.reshape(groups, d),
        correction_covariance=0.5 * (inverse + inverse.T),
        error=errors.reshape(-1),
        root=root,
        design=design,
        freedom=len(error) - design.shape[1] - _columns(unsaid) + _columns(undetermined),
        unsaid=unsaid,
        undetermined=undetermined,
    )


def _columns(basis: np.ndarray | None) -> int:
    return 0 if basis is None else basis.shape[1]


def _unsaid(root: np.ndarray, free: Float[np.ndarray, "k d f"]) -> Float[np.ndarray, "k*d s"]:
    """An orthonormal basis of L⁻¹ N, N of all closures: each has rows of its own."""
    from scipy.linalg import solve_triangular

    count, d, width = free.shape
    rows = np.zeros((count, d, count, width))
    rows[np.arange(count), :, np.arange(count)] = free
    flat = rows.reshape(count * d, count * width)
    return np.linalg.qr(solve_triangular(root, flat[:, flat.any(axis=0)], lower=True))[0]


def _determined(
    before: Float[np.ndarray, "k*d n"], design: Float[np.ndarray, "k*d n"]
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n u"]]:
    """The covariance of what closures determine of w, and a basis of what they do not.

    Args:
        before: the whitened design, which closures that say all would have.
        design: what is left of it when unsaid directions are taken out.
    """
    upper = np.linalg.qr(before)[1]
    _, values, turned = np.linalg.svd(np.linalg.solve(upper.T, design.T).T, full_matrices=False)
    directions = np.linalg.solve(upper, turned.T)
    said = values > DIFFERENT
    scaled = directions[:, said] / values[said]
    return scaled @ scaled.T, directions[:, ~said]


def drops(
    projection: Float[np.ndarray, "k d k d"], pull: Float[np.ndarray, "k d"], singular: bool = False
) -> Any:
    """The amount by which χ² falls if one closure leaves, for each: gᵤᵀ Pᵤᵤ⁻¹ gᵤ.

    Args:
        projection: P of all closures.
        pull: g = P e.
        singular: whether closures leave directions unsaid, along which P is zero.

    Returns:
        `[k]`; a closure by itself pulls at nothing.
    """
    if len(pull) < 2:
        return np.zeros(len(pull))
    index = np.arange(len(pull))
    own = projection[index, :, index]
    if singular:
        solved = np.linalg.pinv(own, rcond=ROUNDING, hermitian=True) @ pull[..., None]
    else:
        solved = np.linalg.solve(own, pull[..., None])
    return np.einsum("kd,kd->k", pull, solved[..., 0])


def stack_closures(evidence: PairEvidence, rows: Int[np.ndarray, " k"]) -> StackedClosures:
    """Gathers the placements and covariances of some of a pair's closures.

    Args:
        evidence: of two maps; see `weigh`.
        rows: which of its closures.

    Raises:
        InputError: for evidence without maps, as `PairEvidence.from_squared` makes it.
    """
    (a, b), measured = maps_of(evidence)
    closures = measured[rows]
    pose_a, pose_b = np.asarray(closures.pose_a), np.asarray(closures.pose_b)
    seen = lie.compose(lie.take(a.frame, pose_a), lie.as_numpy(closures.measurement))
    ends = lie.take(b.frame, pose_b)
    adjoint = np.asarray(lie.adjoint(seen))
    covariance, free = noise_of(np.asarray(closures.information, np.float64))
    return StackedClosures(
        placements=lie.compose(seen, lie.inverse(ends)),
        noise=adjoint @ covariance @ adjoint.swapaxes(1, 2),
        of_a=_gathered(a, pose_a),
        of_b=_gathered(b, pose_b),
        lever=1.0 + float(np.sqrt((lie.translation(ends) ** 2).sum(axis=1).mean())),
        free=None if free is None else adjoint @ free,
    )


def maps_of(
    evidence: PairEvidence,
) -> tuple[tuple[MapCovariance, MapCovariance], LoopClosures]:
    """The covariances of two maps and the closures between them.

    Raises:
        InputError: for evidence without maps, as `PairEvidence.from_squared` makes it.
    """
    if evidence.covariances is None or evidence.measured is None:
        raise InputError(
            "evidence: of distances alone, expected that of two maps and the closures between "
            "them, as weigh(graph) gives"
        )
    return evidence.covariances, evidence.measured


def _gathered(covariance: MapCovariance, poses: np.ndarray) -> Float[np.ndarray, "k d k d"]:
    """The joint covariance of the poses of closures, which may share some."""
    d = covariance.pose_graph.tangent_dim
    unique, index = np.unique(poses, return_inverse=True)
    joint = covariance.joint(unique, side="left").reshape(len(unique), d, len(unique), d)
    return _blocks(joint, index)


def _blocks(matrix: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return matrix[rows][:, :, rows]


def _exp(like: Any, tangent: Any) -> Any:
    return lie.exp(lie.group_of(like), tangent)
