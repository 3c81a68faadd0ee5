"""Joint marginals of the poses that closures touch, against GTSAM's one big joint.

Both sides factorise anew every time. GTSAM's is one call of `jointMarginalCovariance` for all the
poses: asking it pair by pair would take minutes to hours.

Agreement is the largest difference relative to the largest entry. Where the entry's own σᵢ σⱼ is
the measure it is larger, for a reason on GTSAM's side: the Jacobian of `Pose2`'s logarithm divides
by 1 − cos θ, which has few digits left at the residuals' small angles.
"""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float

from benchmarks.suite import gtsam_peer, maps
from benchmarks.suite.harness import Case, Measured, Metric, NotMeasuredError, Settings
from benchmarks.suite.measure import against, in_words, race, seconds_of, timing_of
from pcm_jax import PoseGraph, joint_marginal_covariance, optimize, split

COUNTS = {100: 1.0, 230: 1.0, 300: 0.3, 1000: 0.3}
"""Touched poses, and how much of GTSAM's time may be used for them; it is never to be slower."""
WHOLE = ("torus3D",)
"""Maps that are taken as they are; others are cut in two, as for a merge."""
OF_WHOLE = (300, 1000)
SLOW = 1000  # GTSAM takes about a minute


def joint(name: str, count: int, settings: Settings) -> dict[str, Measured]:
    """`count` poses of each half of a map, or of the whole: time against GTSAM, agreement."""
    graph = maps.read_map(name, settings)
    parts = (graph,) if name in WHOLE else split(graph, [graph.num_poses // 2]).maps
    found: dict[str, Measured] = {}
    for prefix, part in zip(_prefixes(name), parts, strict=True):
        measured = _of_map(optimize(part).graph, count, settings)
        found |= {f"{prefix}{metric}": each for metric, each in measured.items()}
    return found


def _prefixes(name: str) -> tuple[str, ...]:
    """Beginnings of the names of metrics of a map's parts."""
    return ("",) if name in WHOLE else ("a_", "b_")


def _of_map(graph: PoseGraph, count: int, settings: Settings) -> dict[str, Measured]:
    generator = np.random.default_rng(count)
    touched = 1 + np.sort(generator.choice(graph.num_poses - 1, count, replace=False))

    last: dict[str, Float[np.ndarray, "k*d k*d"]] = {}  # GTSAM's 1,000 are not to be found twice

    def ours() -> None:
        last["ours"] = joint_marginal_covariance(graph, touched)

    first = seconds_of(ours)
    try:
        factors, values = gtsam_peer.factors_and_values(graph, "marginals")
    except NotMeasuredError as reason:
        alone = f"{in_words(timing_of(ours, settings.patience).median)}; {reason}"
        return dict.fromkeys(("over_gtsam", "agreement"), Measured(None, alone))

    def theirs() -> None:
        last["gtsam"] = gtsam_peer.joint_marginal_covariance(factors, values, touched)

    times = race({"ours": lambda: ours, "gtsam": lambda: theirs}, settings.patience)
    us, them = times["ours"], times["gtsam"]
    expected = gtsam_peer.in_our_order(last["gtsam"], graph.tangent_dim)
    largest, scaled = _differences(last["ours"], expected)
    return {
        "over_gtsam": Measured(
            us.median / them.median, f"{against(us, them)}; first call {in_words(first)}"
        ),
        "agreement": Measured(largest, f"{scaled:.1e} in units of σᵢ σⱼ"),
    }


def _differences(
    found: Float[np.ndarray, "k k"], expected: Float[np.ndarray, "k k"]
) -> tuple[float, float]:
    """Largest difference, relative to the largest entry, and in units of σᵢ σⱼ."""
    difference, sigma = np.abs(found - expected), np.sqrt(np.diagonal(expected))
    scaled = difference / (sigma[:, None] * sigma)
    return float(difference.max() / np.abs(expected).max()), float(scaled.max())


def _case(name: str, count: int) -> Case:
    metrics = [
        metric
        for prefix in _prefixes(name)
        for metric in (
            Metric(f"{prefix}over_gtsam", "×", figure=COUNTS[count]),
            Metric(f"{prefix}agreement", "relative", figure=1e-6, tolerance=None, digits=2),
        )
    ]
    measure = functools.partial(joint, name, count)
    case = Case(f"marginals/{name}-{count}", metrics, measure, slow=count >= SLOW)
    return case._replace(applies=maps.stand_ins_needed) if name in maps.SIMULATED else case


CASES = [
    *(_case(name, count) for name in ("city10000", "simulated-city") for count in COUNTS),
    *(_case(name, count) for name in WHOLE for count in OF_WHOLE),
]
