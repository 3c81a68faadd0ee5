"""Differential tests: random cases against programs that share nothing with the package.

    python -m tests.long.differential --count 2000

Costs, poses and marginals of random maps against GTSAM, cliques (also weighted) of random graphs
against networkx, gates against SciPy's `chi2`. `tests/mapping/test_covariance.py`,
`tests/clique` and `tests/consistency/test_gate.py` hold the small forms.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jaxlie
import networkx
import numpy as np
from scipy.stats import chi2

import pcm_jax as pcm
from pcm_jax import lie
from pcm_jax.graph import PoseGraph

from ._log import LOGS, commit, found_in, machine, table


def random_map(rng: np.random.Generator) -> PoseGraph:
    """A random walk with loops, of either group; noise of random covariance, matched."""
    group = jaxlie.SE2 if rng.random() < 0.5 else jaxlie.SE3
    d, n = lie.tangent_dim(group), int(rng.integers(3, 30))
    steps = rng.normal(scale=0.4, size=(n, d)) + np.eye(d)[0]
    truth = [lie.exp(group, np.zeros(d))]
    for step in steps[1:]:
        truth.append(lie.compose(truth[-1], lie.exp(group, step)))
    ends = rng.integers(0, n, (int(rng.integers(1, n)), 2))
    ends = ends[ends[:, 0] != ends[:, 1]]
    tail, head = np.r_[: n - 1, ends[:, 0]], np.r_[1:n, ends[:, 1]]
    truth = lie.stack(truth)
    left, sizes, right = np.linalg.svd(np.eye(d) + 0.3 * rng.normal(size=(len(tail), d, d)))
    root = 0.02 * (left * np.clip(sizes, 0.2, None)[:, None]) @ right  # GTSAM refuses worse ones
    error = np.einsum("eij,ej->ei", root, rng.normal(size=(len(tail), d)))
    exact = lie.between(lie.take(truth, tail), lie.take(truth, head))
    start = lie.compose(truth, lie.exp(group, rng.normal(scale=0.02, size=(n, d))))
    return PoseGraph.from_arrays(
        poses=start,
        tail=tail,
        head=head,
        measurement=lie.compose(exact, lie.exp(group, error)),
        covariance=root @ root.transpose(0, 2, 1),
    )


class Gtsam:
    """A map as GTSAM's factors and values, by matrices."""

    def __init__(self, graph: PoseGraph):
        import gtsam

        self.gtsam, self.d = gtsam, graph.tangent_dim
        self.order = [3, 4, 5, 0, 1, 2] if self.d == 6 else [0, 1, 2]  # rotation first in 3D
        self.kind = "Pose3" if self.d == 6 else "Pose2"
        self.factors, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for index, matrix in enumerate(np.asarray(lie.as_matrix(graph.poses))):
            self.values.insert(index, self.pose(matrix))
        factor = getattr(gtsam, f"BetweenFactor{self.kind}")
        matrices = np.asarray(lie.as_matrix(graph.measurement))
        for i, j, z, omega in zip(
            graph.tail, graph.head, matrices, np.asarray(graph.information), strict=True
        ):
            noise = gtsam.noiseModel.Gaussian.Information(omega[np.ix_(self.order, self.order)])
            self.factors.add(factor(int(i), int(j), self.pose(z), noise))

    def pose(self, matrix: np.ndarray) -> Any:
        if self.d == 6:
            return self.gtsam.Pose3(matrix)
        angle = np.arctan2(matrix[1, 0], matrix[0, 0])
        return self.gtsam.Pose2(matrix[0, 2], matrix[1, 2], angle)

    def held(self) -> Gtsam:
        """With the first pose held, exactly."""
        sure = self.gtsam.noiseModel.Constrained.All(self.d)
        first = getattr(self.values, f"at{self.kind}")(0)
        self.factors.add(getattr(self.gtsam, f"PriorFactor{self.kind}")(0, first, sure))
        return self

    def optimized(self) -> tuple[float, np.ndarray]:
        """Its own optimum: the cost and the poses' matrices."""
        settings = self.gtsam.LevenbergMarquardtParams()
        settings.setRelativeErrorTol(1e-13)
        settings.setAbsoluteErrorTol(1e-13)
        solver = self.gtsam.LevenbergMarquardtOptimizer(self.factors, self.values, settings)
        found = solver.optimize()
        poses = [getattr(found, f"at{self.kind}")(k).matrix() for k in range(found.size())]
        return self.factors.error(found), np.array(poses)

    def marginal(self, poses: np.ndarray) -> np.ndarray:
        """The joint covariance in our order."""
        joint = self.gtsam.Marginals(self.factors, self.values)
        whole = joint.jointMarginalCovariance(poses.tolist()).fullMatrix()
        rows = (np.arange(len(poses))[:, None] * self.d + np.array(self.order)).ravel()
        return whole[np.ix_(rows, rows)]


def cost(rng: np.random.Generator) -> str | None:
    """Our cost of the given poses, as `optimize` states it before its first step."""
    graph = random_map(rng)
    ours, theirs = pcm.optimize(graph, initial="given").initial_cost, Gtsam(graph)
    error = theirs.factors.error(theirs.values)
    return None if np.isclose(ours, error, rtol=1e-9) else f"cost {ours}, {error} by GTSAM"


def poses(rng: np.random.Generator) -> str | None:
    """The optimum: cost and poses, the first one held."""
    graph = random_map(rng)
    solution = pcm.optimize(graph, initial="given")
    error, matrices = Gtsam(graph).held().optimized()
    if not np.isclose(solution.cost, error, rtol=1e-6, atol=1e-9):
        return f"cost {solution.cost}, {error} by GTSAM"
    gap = np.abs(np.asarray(lie.as_matrix(solution.graph.poses)) - matrices).max()
    return None if gap < 1e-5 else f"poses {gap} from GTSAM's"


def marginals(rng: np.random.Generator) -> str | None:
    """The joint covariance of up to four poses."""
    graph = pcm.optimize(random_map(rng), initial="given").graph
    most = min(4, graph.num_poses - 1)
    wanted = np.sort(1 + rng.permutation(graph.num_poses - 1)[: rng.integers(1, most + 1)])
    ours, theirs = (
        pcm.joint_marginal_covariance(graph, wanted),
        Gtsam(graph).held().marginal(wanted),
    )
    gap = np.abs(ours - theirs).max() / np.abs(theirs).max()
    return None if gap < 1e-6 else f"covariance {gap:.1e} from GTSAM's"


def cliques(rng: np.random.Generator) -> str | None:
    """The largest clique's size, and the heaviest one's weight."""
    n = int(rng.integers(1, 45))
    upper = np.triu(rng.random((n, n)) < rng.uniform(0.1, 0.9), 1)
    consistent = upper | upper.T
    weights = rng.integers(1, 50, n)
    graph = networkx.from_numpy_array(consistent)
    networkx.set_node_attributes(graph, dict(enumerate(weights.tolist())), "weight")
    for ours, name in ((None, None), (weights.astype(float), "weight")):
        found = pcm.maximum_clique(consistent, weights=ours)
        members = np.flatnonzero(found.members)
        _, best = networkx.max_weight_clique(graph, weight=name)
        value = len(members) if name is None else int(weights[members].sum())
        if value != best or not found.optimal:
            return f"{value} {'vertices' if name is None else 'of weight'}, {best} by networkx"
        inside = consistent[np.ix_(members, members)] | np.eye(len(members), dtype=bool)
        if not inside.all():
            return "no clique"
    return None


def gates(rng: np.random.Generator) -> str | None:
    """The chi-squared quantile, from deep in one tail to deep in the other."""
    confidence = float(rng.choice([rng.random(), 10 ** -rng.uniform(0, 12)]))
    confidence = 1 - confidence if rng.random() < 0.3 else confidence
    dof = int(rng.integers(1, 400))
    if not 0.0 < confidence < 1.0:
        return None
    ours, theirs = float(pcm.chi2_gate(confidence, dof)), chi2.ppf(confidence, dof)
    return None if np.isclose(ours, theirs, rtol=1e-9) else f"gate {ours}, {theirs} by SciPy"


KINDS: dict[str, tuple[Callable[[np.random.Generator], str | None], float, str]] = {
    "costs": (cost, 0.2, "GTSAM"),
    "poses": (poses, 0.2, "GTSAM"),
    "marginals": (marginals, 0.2, "GTSAM"),
    "cliques": (cliques, 0.2, "networkx"),
    "gates": (gates, 0.2, "SciPy"),
}


def run(count: int, seed: int) -> list[tuple[str, int, list[str]]]:
    """Tries as many cases in all; gives for each kind how many, and where they differ."""
    found = []
    for number, (name, (check, share, _)) in enumerate(KINDS.items()):
        cases = round(count * share)
        wrong = []
        for case in range(cases):
            differs = check(np.random.default_rng([seed, number, case]))
            wrong += [f"{name} {case}: {differs}"] if differs else []
        sys.stderr.write(f"{name}: {cases}, {len(wrong)} differ\n")
        found.append((name, cases, wrong))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.differential", description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--out", type=Path, default=LOGS / "differential.md")
    given = parser.parse_args()
    began = time.perf_counter()
    found = run(given.count, given.seed)
    rows: list[list[object]] = [
        [name, cases, KINDS[name][2], len(wrong)] for name, cases, wrong in found
    ]
    wrong = [one for _, _, each in found for one in each]
    given.out.write_text(
        f"# Random cases against other programs\n\n`python -m tests.long.differential --count"
        f" {given.count} --seed {given.seed}`. Commit {commit()}; {machine()};"
        f" {time.perf_counter() - began:.0f} s.\n\n"
        + table(["of", "cases", "against", "differ"], rows)
        + found_in(wrong)
    )


if __name__ == "__main__":
    main()
