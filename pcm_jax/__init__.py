"""Pairwise consistent measurement set maximization (PCM) in JAX.

From the pose graphs of several robots and a pile of candidate loop closures between them, most of
which may be wrong, to the closures to believe and one merged map:

    graph = pcm_jax.read_graph("a.g2o", "b.g2o", closures="candidates.csv")
    result = pcm_jax.merge(graph)

The names below and the modules `evaluation`, `experiments`, `integrity`, `lie`, `plots` and
`simulation` are loaded when first used, so that `import pcm_jax` costs next to nothing.

These go through JAX's transformations, alone and inside each other; – says that the result is a
choice, constant between its jumps:

| function | `jit` | `vmap` | `grad` | `jvp` |
|---|---|---|---|---|
| `squared_mahalanobis` | yes | yes | yes | yes |
| `squared_mahalanobis_of` | yes | yes | yes | yes |
| `chi2_gate` | yes | yes | yes | yes |
| `consistency_graph` | yes | yes | – | – |
| `maximum_clique_batched` | yes | yes | – | – |
| `select_batched` | yes | yes | – | – |
| `soft_select` | yes | yes | yes | yes |
| `merge_differentiable` | yes | yes | yes | yes |
| `true_positive_rate` | yes | yes | – | – |
| `ate_rmse` | yes | yes | yes | yes |
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pcm_jax import evaluation, experiments, integrity, lie, plots, simulation  # noqa: F401
    from pcm_jax.clique import Clique, maximum_clique, maximum_clique_batched
    from pcm_jax.consistency import (
        AlignmentDifference,
        ConsistencyProblem,
        Evidence,
        JointConsistency,
        PackedGraph,
        PairEvidence,
        alignment_difference,
        chi2_gate,
        consistency_graph,
        consistency_problem,
        joint_consistency,
        squared_mahalanobis,
        squared_mahalanobis_of,
        stream_consistency_graph,
        to_networkx,
    )
    from pcm_jax.errors import ConvergenceWarning, FileFormatError, InputError, InputWarning
    from pcm_jax.evaluation import ate_rmse, false_positive_rate, precision, true_positive_rate
    from pcm_jax.experiments import sweep
    from pcm_jax.files import (
        from_gtsam,
        read_graph,
        read_trajectory,
        to_gtsam,
        write_g2o,
        write_trajectory,
    )
    from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph, pad_graph, split
    from pcm_jax.mapping import MapCovariance, Solution, joint_marginal_covariance, optimize
    from pcm_jax.merging import MergeResult, merge_differentiable
    from pcm_jax.online import IncrementalPcm, IncrementalWithin
    from pcm_jax.pipeline import calibrate, clean_maps, merge, select, select_within, weigh
    from pcm_jax.selection import (
        Selection,
        WithinSelection,
        select_batched,
        select_from,
        soft_select,
    )

__version__ = "0.1.0"

__all__ = [
    "AlignmentDifference",
    "Clique",
    "ConsistencyProblem",
    "ConvergenceWarning",
    "Evidence",
    "FileFormatError",
    "IncrementalPcm",
    "IncrementalWithin",
    "InputError",
    "InputWarning",
    "JointConsistency",
    "LoopClosures",
    "MapCovariance",
    "MergeResult",
    "MultiRobotGraph",
    "PackedGraph",
    "PairEvidence",
    "PoseGraph",
    "Selection",
    "Solution",
    "WithinSelection",
    "alignment_difference",
    "ate_rmse",
    "calibrate",
    "chi2_gate",
    "clean_maps",
    "consistency_graph",
    "consistency_problem",
    "false_positive_rate",
    "from_gtsam",
    "joint_consistency",
    "joint_marginal_covariance",
    "maximum_clique",
    "maximum_clique_batched",
    "merge",
    "merge_differentiable",
    "optimize",
    "pad_graph",
    "precision",
    "read_graph",
    "read_trajectory",
    "select",
    "select_batched",
    "select_from",
    "select_within",
    "soft_select",
    "split",
    "squared_mahalanobis",
    "squared_mahalanobis_of",
    "stream_consistency_graph",
    "sweep",
    "to_gtsam",
    "to_networkx",
    "true_positive_rate",
    "weigh",
    "write_g2o",
    "write_trajectory",
]

_NAMES_OF = {
    "errors": ("ConvergenceWarning", "FileFormatError", "InputError", "InputWarning"),
    "graph": ("LoopClosures", "MultiRobotGraph", "PoseGraph", "pad_graph", "split"),
    "files": (
        "from_gtsam",
        "read_graph",
        "read_trajectory",
        "to_gtsam",
        "write_g2o",
        "write_trajectory",
    ),
    "mapping": ("MapCovariance", "Solution", "joint_marginal_covariance", "optimize"),
    "consistency": (
        "AlignmentDifference",
        "ConsistencyProblem",
        "Evidence",
        "JointConsistency",
        "PackedGraph",
        "PairEvidence",
        "alignment_difference",
        "chi2_gate",
        "consistency_graph",
        "consistency_problem",
        "joint_consistency",
        "squared_mahalanobis",
        "squared_mahalanobis_of",
        "stream_consistency_graph",
        "to_networkx",
    ),
    "clique": ("Clique", "maximum_clique", "maximum_clique_batched"),
    "selection": (
        "Selection",
        "WithinSelection",
        "select_batched",
        "select_from",
        "soft_select",
    ),
    "evaluation": ("ate_rmse", "false_positive_rate", "precision", "true_positive_rate"),
    "experiments": ("sweep",),
    "merging": ("MergeResult", "merge_differentiable"),
    "online": ("IncrementalPcm", "IncrementalWithin"),
    "pipeline": ("calibrate", "clean_maps", "merge", "select", "select_within", "weigh"),
}
_HOME_OF = {name: home for home, names in _NAMES_OF.items() for name in names}


_MODULES = ("evaluation", "experiments", "integrity", "lie", "plots", "simulation")


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_MODULES})
