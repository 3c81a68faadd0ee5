"""The weights of closures: which methods go by them, and what is said where one cannot.

`LoopClosures.weight` is how much a front end trusts a closure. Where the weights of a robot pair's
closures differ, the PCM methods look for the heaviest set instead of the largest; where they are
all equal, there is nothing to weigh and the answer is the unweighted one. Closures of weight 0 are
never kept.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from pcm_jax.consistency import PairEvidence
from pcm_jax.errors import InputWarning
from pcm_jax.graph import LoopClosures, MultiRobotGraph
from pcm_jax.graph.checked import as_weights
from pcm_jax.selection.methods import METHODS


def weights_for(method: Any, evidence: PairEvidence) -> dict[str, Any]:
    """The option that gives a method the weights of a pair's closures, if it goes by them."""
    if not _goes_by_weights(method) or evidence.measured is None:
        return {}
    weights = np.asarray(evidence.measured.weight, np.float64)
    return {"weights": weights} if _differ(weights) else {}


def check_weights(method: Any, graph: MultiRobotGraph) -> None:
    """Checks the weights of a graph's closures.

    A function of one's own has them in its evidence (`measured.weight`), so nothing is said there.

    Args:
        method: a name, of whatever kind of method, or a function.
        graph: whose closures.

    Raises:
        InputError: for a weight that is negative or not finite, with its index.

    Warns:
        InputWarning: where weights differ and the method cannot go by them.
    """
    closures = graph.closures
    weights = as_weights(closures.weight, len(closures))
    if callable(method) or _goes_by_weights(method):
        return
    for a, b in closures.pairs():
        if _differ(weights[_between(closures, a, b)]):
            by_weight = ", ".join(name for name in METHODS if _goes_by_weights(name))
            warnings.warn(
                f"weight: the closures between {graph.names[a]} and {graph.names[b]} differ in it, "
                f"which method {method!r} takes no notice of; {by_weight} do",
                InputWarning,
                stacklevel=4,
            )
            return


def _goes_by_weights(method: Any) -> bool:
    return isinstance(method, str) and method in METHODS and "weights" in METHODS[method].options


def _differ(weights: Float[np.ndarray, " k"]) -> bool:
    """True for weights that decide something: unequal ones, or all of them 0."""
    return bool(len(weights)) and bool((weights != weights[0]).any() or weights[0] == 0.0)


def _between(closures: LoopClosures, a: int, b: int) -> Bool[np.ndarray, " m"]:
    robot_a, robot_b = np.asarray(closures.robot_a), np.asarray(closures.robot_b)
    return ((robot_a == a) & (robot_b == b)) | ((robot_a == b) & (robot_b == a))
