"""Calibration: a 95 % gate lets 95 % of the pairs of right closures pass.

Every world has two maps with loops, optimised by `optimize` from their chordal poses, joint
marginals by `joint_marginal_covariance`: the path that users' data takes. All noise is drawn with
the covariance that is recorded for it.
"""

from __future__ import annotations

import functools

import jaxlie
import numpy as np

from benchmarks.suite.harness import Case, Measured, Metric, Settings
from benchmarks.suite.random_worlds import NOISE, random_closures, random_map
from pcm_jax import chi2_gate, consistency_problem, lie, optimize, squared_mahalanobis

GROUPS = {"SE2": jaxlie.SE2, "SE3": jaxlie.SE3}
WORLDS, CLOSURES = 400, 12
CONFIDENCE = 0.95


def accepted(group: str, settings: Settings) -> dict[str, Measured]:
    """The share of ordered pairs within the gate, over all worlds."""
    generator = np.random.default_rng(2018)
    dof = lie.tangent_dim(GROUPS[group])
    gate = float(chi2_gate(CONFIDENCE, dof))
    shares = np.array([_one_world(group, generator, gate) for _ in range(WORLDS)])
    error = shares.std(ddof=1) / np.sqrt(WORLDS)
    note = f"{WORLDS} worlds of {CLOSURES * (CLOSURES - 1)} pairs; standard error {100 * error:.2f}"
    return {"accepted": Measured(100 * shares.mean(), note)}


def _one_world(group: str, generator: np.random.Generator, gate: float) -> float:
    given = [random_map(GROUPS[group], generator) for _ in range(2)]
    truth = [lie.as_numpy(graph.poses) for graph in given]
    closures = random_closures(generator, given, CLOSURES, truth=truth, noise=NOISE)
    map_a, map_b = (optimize(graph).graph for graph in given)
    squared = np.asarray(squared_mahalanobis(consistency_problem(map_a, map_b, closures)))
    return float((squared[~np.eye(CLOSURES, dtype=bool)] <= gate).mean())


CASES = [
    Case(
        f"calibration/{group}",
        (Metric("accepted", "%", "target", figure=(94.0, 96.0), tolerance=0.01, digits=4),),
        functools.partial(accepted, group),
    )
    for group in GROUPS
]
