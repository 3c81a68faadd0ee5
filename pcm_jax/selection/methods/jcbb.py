"""Joint compatibility: the largest set that passes as a whole, not only pair by pair.

J. Neira and J. D. Tardós, "Data association in stochastic mapping using the joint compatibility
test", IEEE Trans. Robotics and Automation 17 (2001), the paper's [11]. A set of n closures is kept
if every two pass the gate and their joint χ² (`joint_consistency`) is below the quantile for
(n − 1) d degrees of freedom at the gate's own confidence. Of equally large sets, the one whose
sorted tuple of indices is the smallest. Needs the maps' covariances, not distances alone.

No set can be larger than a maximum clique of the consistency graph. If that passes it is the
answer. Else it is repaired greedily (the closure whose leaving takes most off χ² leaves, until the
rest passes; then others are tried), and a branch and bound looks for something better. χ² never
falls as a set grows, while its quantile rises: a set is given up when its χ² is above the quantile
of the largest set it can still become. How large that is a greedy colouring bounds, and χ² itself:
with the candidates' errors, given the members, each made white by itself, and N their covariance
then, any t of them raise χ² by at least the sum of the t least rises over the largest eigenvalue of
t blocks of N (bounded by Gershgorin's rows of blocks). Within a branch χ² is linear about the
alignment of its first member; a twentieth is spared for what that leaves out, and a set is only
kept by the joint test itself.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pcm_jax import lie
from pcm_jax.arrays import on_host
from pcm_jax.clique import maximum_clique
from pcm_jax.consistency import PairEvidence, chi2_gate
from pcm_jax.consistency.joint import chosen_rows, quantiles
from pcm_jax.consistency.stacked import StackedClosures, drops, maps_of, stack_closures
from pcm_jax.errors import InputError
from pcm_jax.selection.method import Choice, SelectionMethod

LARGEST = 1000
"""Closures of a set, with those that may join it: (1000·6)² numbers are 288 MB."""
SEARCHED, BRANCHES = 80, 5_000
"""Closures that the branch and bound takes, and sets that it looks at, at most: some seconds."""
OF_A_TEST = 10
"""Branches that take as long as one joint test."""
SPARED = 1.05
"""The share of a quantile up to which a linear χ² is not yet above it."""


@on_host
def jcbb(evidence: PairEvidence, gate: float, *, time_limit: float | None = None) -> Choice:
    """The largest set that is consistent pair by pair and as a whole.

    Args:
        evidence: of two maps, see `weigh`.
        gate: γ² of a pair, d degrees of freedom; its confidence is the whole set's too.
        time_limit: seconds; when they are over, the best set so far is returned.

    Returns:
        The set; optimal if the search came to its end, as it mostly does to about 30 closures.

    Raises:
        InputError: for evidence of distances alone, and for a set of more than 1,000 closures.
    """
    return _largest_within(evidence, np.arange(len(evidence)), gate, time_limit)


@on_host
def repair(
    evidence: PairEvidence,
    accepted: Any,
    *,
    confidence: float = 0.99,
    time_limit: float | None = None,
) -> Choice:
    """The largest jointly consistent subset of a set of closures, for one that fails the test.

        joint = pcm_jax.joint_consistency(pair.evidence, pair.accepted)
        if joint.p < 0.01:
            kept = pcm_jax.selection.repair(pair.evidence, pair.accepted).members

    Args:
        evidence: of two maps, see `weigh`.
        accepted: bool `[k]` or indices among the pair's closures.
        confidence: of the joint test, and of every pair's.
        time_limit: seconds; when they are over, the best set so far is returned.

    Returns:
        The subset, `members` bool `[k]`, with its certificate; see `jcbb`.

    Raises:
        InputError: as `joint_consistency` and `jcbb`.
    """
    rows = np.sort(chosen_rows(evidence, accepted, "accepted"))
    gate = float(chi2_gate(confidence, maps_of(evidence)[1].tangent_dim))
    return _largest_within(evidence, rows, gate, time_limit)


def _largest_within(
    evidence: PairEvidence, inside: np.ndarray, gate: float, time_limit: float | None
) -> Choice:
    deadline = np.inf if time_limit is None else perf_counter() + time_limit
    maps_of(evidence)
    graph = evidence.consistent(gate)[np.ix_(inside, inside)].copy()
    np.fill_diagonal(graph, False)
    clique = maximum_clique(graph, time_limit=time_limit)
    if clique.size > LARGEST:
        raise InputError(
            f"evidence: {clique.size} closures agree pair by pair, expected at most {LARGEST} for "
            "method 'jcbb'"
        )
    members, bound = np.flatnonzero(clique.members), clique.upper_bound
    rest = np.arange(len(members))
    if len(members) > 1:
        rest = JointSets(evidence, inside[members], gate).shrunk(rest)
    if len(rest) < len(members):
        members, proven = _better(evidence, inside, graph, members[rest], gate, deadline)
        bound = len(members) if proven else bound
    mask = np.zeros(len(evidence), bool)
    mask[inside[members]] = True
    return Choice(mask, len(members) == bound, bound)


def _better(
    evidence: PairEvidence,
    inside: np.ndarray,
    graph: np.ndarray,
    members: np.ndarray,
    gate: float,
    deadline: float,
) -> tuple[np.ndarray, bool]:
    """The largest set if the search for it ends, else the given one with what can join it."""
    core = _core(graph, len(members) - 1)
    searched = len(core) <= SEARCHED
    if not searched:
        joining = np.flatnonzero(graph[:, members].all(axis=1))
        core = np.sort(np.concatenate([members, joining[: LARGEST - len(members)]]))
    sets, near = JointSets(evidence, inside[core], gate), graph[np.ix_(core, core)]
    greedy = sets.grown(np.searchsorted(core, members), near)
    if not searched:
        return core[greedy], False
    search = _Search(sets, near, len(greedy) - 1, deadline)
    proven, found = search.run(), np.array(search.best, np.int64)
    if len(found) < len(greedy):
        return core[greedy], False
    return core[found], proven


def _core(graph: Bool[np.ndarray, "k k"], degree: int) -> Int[np.ndarray, " n"]:
    """All that a clique of `degree` + 1 vertices can consist of."""
    inside = np.arange(len(graph))
    while len(inside):
        kept = graph[np.ix_(inside, inside)].sum(axis=1) >= degree
        if kept.all():
            break
        inside = inside[kept]
    return inside


class JointSets:
    """The sets among some closures that pass the joint test; indices are among these.

    Args:
        evidence: of two maps.
        rows: which of its closures.
        gate: γ² of a pair.
    """

    def __init__(self, evidence: PairEvidence, rows: Int[np.ndarray, " k"], gate: float):
        self.stacked: StackedClosures = stack_closures(evidence, rows)
        self.stacked.check_all_said("method 'jcbb'")
        self.largest = quantiles(gate, self.stacked.dim, len(rows))

    def passes(self, members: Any) -> bool:
        """Tells whether χ² of a set is at most its quantile."""
        squared = self.stacked.take(np.asarray(members)).fit().squared if len(members) > 1 else 0.0
        return squared <= self.largest[len(members)]

    def shrunk(self, members: Int[np.ndarray, " n"]) -> Int[np.ndarray, " o"]:
        """The rest, after the closure that most contradicts the others has left, till all pass."""
        while len(members) > 1:
            fit = self.stacked.take(members).fit()
            if fit.squared <= self.largest[len(members)]:
                break
            members = members[_kept(fit, self.largest)]
        return members

    def grown(
        self, members: Int[np.ndarray, " n"], graph: Bool[np.ndarray, "k k"]
    ) -> Int[np.ndarray, " o"]:
        """A passing set with those that can join it one by one, the least rise of χ² first."""
        while True:
            others = np.flatnonzero(graph[:, members].all(axis=1)) if len(members) else members
            rises = self.stacked.increases(members, others) if len(others) else np.zeros(0)
            for one in others[np.argsort(rises, kind="stable")]:
                wider = np.sort(np.append(members, one))
                if self.passes(wider):
                    break
            else:
                return members
            members = wider


def _kept(fit: Any, largest: np.ndarray) -> Int[np.ndarray, " o"]:
    """The members left, at least one fewer, when χ² by the linear fit is below its quantile."""
    projection, kept = fit.projection(), np.arange(len(fit.error) // fit.correction.shape[1])
    pull = np.einsum("adbe,be->ad", projection, fit.error.reshape(projection.shape[:2]))
    squared = fit.squared
    while True:
        fall = drops(projection, pull)
        worst = int(np.argmax(fall))
        squared -= fall[worst]
        own = projection[worst, :, worst]
        by_worst = np.linalg.solve(own, projection[worst].reshape(len(own), -1))
        left = projection[:, :, worst] @ by_worst.reshape(len(own), -1)
        pull = pull - projection[:, :, worst] @ np.linalg.solve(own, pull[worst])
        projection = projection - left.reshape(projection.shape)
        rest = np.delete(np.arange(len(kept)), worst)
        kept, pull = kept[rest], pull[rest]
        projection = projection[rest][:, :, rest]
        if len(kept) < 2 or squared <= largest[len(kept)]:
            return kept


class _Branch:
    """The candidates that may follow some members, given which their errors are predicted.

    Attributes:
        members: indices, ascending.
        squared: χ² of the members, linear about the first one's alignment.
        candidates: indices after the last member, ascending, consistent with all members.
        error: `[c, d]`, of the candidates, less what the members predict.
        covariance: `[c, d, c, d]`, of that.
    """

    def __init__(
        self,
        members: list[int],
        squared: float,
        candidates: Int[np.ndarray, " c"],
        error: Float[np.ndarray, "c d"],
        covariance: Float[np.ndarray, "c d c d"],
    ):
        self.members, self.squared, self.candidates = members, squared, candidates
        self.error, self.covariance = error, covariance

    @classmethod
    def from_root(cls, stacked: StackedClosures, root: int, near: np.ndarray) -> _Branch:
        """A first member and the candidates; errors are differences from the first one's."""
        about = lie.take(stacked.placements, root)
        own = stacked.take(np.append(root, near))
        total = own.covariance(about)
        total = total[1:] - total[0]
        total = total[:, :, 1:] - total[:, :, 0][:, :, None]
        return cls([root], 0.0, near, own.errors(about)[1:], total)

    def rises(self) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c+1"]]:
        """The rise of χ² by each candidate, and the least by any 0 … c of them together."""
        index = np.arange(len(self.candidates))
        white = np.linalg.inv(np.linalg.cholesky(self.covariance[index, :, index]))
        rises = np.sum((white @ self.error[..., None]) ** 2, axis=(1, 2))
        blocks = white[:, None] @ self.covariance.swapaxes(1, 2) @ white.swapaxes(1, 2)
        sizes = np.abs(blocks)
        norms = np.sqrt(sizes.sum(axis=2).max(axis=2) * sizes.sum(axis=3).max(axis=2))
        norms[index, index] = np.inf  # to be the first when sorted; it is 1
        norms = np.sort(norms, axis=1)[:, ::-1]
        norms[:, 0] = 1.0
        together = np.cumsum(np.sort(rises)) / norms.cumsum(axis=1).max(axis=0)
        return rises, np.append(0.0, together)

    def followed(self, at: int, squared: float, kept: Int[np.ndarray, " n"]) -> _Branch:
        """The branch with the candidate at a place as a member, and some of the others left."""
        count, d = len(kept), self.error.shape[1]
        cross = self.covariance[kept][:, :, at].reshape(count * d, d)
        gain = np.linalg.solve(self.covariance[at, :, at], cross.T).T
        error = self.error[kept] - (gain @ self.error[at]).reshape(count, d)
        taken = (gain @ cross.T).reshape(count, d, count, d)
        covariance = self.covariance[kept][:, :, kept] - taken
        members = [*self.members, int(self.candidates[at])]
        return _Branch(members, squared, self.candidates[kept], error, covariance)


class _Search:
    """Branch and bound in the order of indices, so that the first set of its size is the smallest.

    Args:
        sets: the joint test.
        graph: pairwise consistency.
        size: of the sets that are too small.
        deadline: reading of `time.perf_counter` at which to give up.
    """

    def __init__(self, sets: JointSets, graph: np.ndarray, size: int, deadline: float):
        self.sets, self.graph, self.size, self.deadline = sets, graph, size, deadline
        self.best: list[int] = []
        self.branches = 0

    def run(self) -> bool:
        """Looks for the largest set above the size, `best`; False if it gave up on the way."""
        every = np.arange(len(self.graph))
        try:
            for root, colours in enumerate(suffix_colours(self.graph)):
                if colours <= self.size:
                    break
                near = every[root + 1 :][self.graph[root, root + 1 :]]
                self._follow(_Branch.from_root(self.sets.stacked, root, near))
        except TimeoutError:
            return False
        return True

    def _follow(self, branch: _Branch) -> None:
        self.branches += 1
        if self.branches > BRANCHES or perf_counter() > self.deadline:
            raise TimeoutError
        largest, count = SPARED * self.sets.largest, len(branch.members)
        if count > self.size and branch.squared <= largest[count]:
            self.branches += OF_A_TEST
            if self.sets.passes(branch.members):
                self.best, self.size = branch.members, count
        if not len(branch.candidates):
            return
        near = self.graph[np.ix_(branch.candidates, branch.candidates)]
        rises, together = branch.rises()
        within = branch.squared + together <= largest[count : count + len(together)]
        reach = count + np.minimum(suffix_colours(near), np.flatnonzero(within)[-1:].max(initial=0))
        squared = branch.squared + rises
        possible = squared <= largest[reach[0]]
        for at in np.flatnonzero(squared <= largest[reach]).tolist():
            if reach[at] <= self.size:
                return
            kept = np.flatnonzero(possible & near[at] & (np.arange(len(near)) > at))
            self._follow(branch.followed(at, float(squared[at]), kept))


def suffix_colours(graph: Bool[np.ndarray, "k k"]) -> Int[np.ndarray, " k"]:
    """The colours that a greedy colouring needs for the vertices from each one on to the last.

    No clique among these has more members.
    """
    colour = np.zeros(len(graph), int)
    needed = np.zeros(len(graph), int)
    for vertex in range(len(graph) - 1, -1, -1):
        taken = set(colour[vertex + 1 :][graph[vertex, vertex + 1 :]].tolist())
        colour[vertex] = next(c for c in range(1, len(graph) + 2) if c not in taken)
        needed[vertex] = colour[vertex:].max()
    return needed


METHODS = (SelectionMethod("jcbb", None, choose_from=jcbb),)
