"""Options that mend a fit that cannot be meant: each is followed on the data before it is named.

A map's own loops say how large its noise is, whatever the closures between robots: its chi-squared
at its optimum, by degree of freedom, is 1 where noise is as stated. Where it is far below, the file
may hold the information's square root. Read so, the maps must fit as stated noise does, not just
better, and the closures must still agree: on real files that state too large sigmas the square is
as wrong, to the other side. `inspect` and `merge` ask the same function.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

from pcm_jax.cli._inputs import graph_to_merge, read
from pcm_jax.cli._progress import Progress
from pcm_jax.errors import InputError
from pcm_jax.graph import MultiRobotGraph, PoseGraph

TOO_GOOD = 0.1  # normalised chi-squared below which the stated noise cannot be meant
AS_STATED = 1.5  # times 1, up or down: a fit that noise as stated gives
LARGEST = 100_000  # poses: larger maps are not solved for a hint


class Fit(NamedTuple):
    """The fit of maps to their own loops.

    Attributes:
        chi2: 2 cost over the degrees of freedom, all maps together, at their optima.
        maps: at their optima.
    """

    chi2: float
    maps: tuple[PoseGraph, ...]


def fit_of(maps: Sequence[PoseGraph]) -> Fit | None:
    """The fit of those maps that have loops; None if none has, or some does not converge."""
    from pcm_jax.mapping import optimize

    looped = [one.without_priors() for one in maps if one.num_edges >= one.num_poses]
    if not looped or sum(one.num_poses for one in looped) > LARGEST:
        return None
    cost, freedom, found = 0.0, 0, []
    for one in looped:
        solution = optimize(one)
        if not solution.converged:
            return None
        cost += solution.cost
        freedom += (one.num_edges - one.num_poses + 1) * one.tangent_dim
        found.append(solution.graph)
    return Fit(2.0 * cost / freedom, tuple(found))


def square_root(
    options: Any, graph: MultiRobotGraph, progress: Progress, *, clean: bool = False
) -> str | None:
    """The hint that information is its square root; None where that does not mend the fit.

    Args:
        options: a command's, of reading.
        graph: as it was read, and is to be merged.
        progress: told what is tried.
        clean: whether false loops are taken out of the maps before.
    """
    if options.information != "as-written" or len(graph.maps) == 0:
        return None
    progress("weighing the maps' own loops")
    stated = _quietly(lambda: fit_of(_own(graph, clean)))
    if stated is None or stated.chi2 >= TOO_GOOD:
        return None
    progress("trying another reading")
    other = copy.copy(options)
    other.information = "sqrt"
    squared = _quietly(lambda: _read_again(other, len(graph.maps)))
    fit = None if squared is None else _quietly(lambda: fit_of(_own(squared, clean)))
    if fit is None or not 1.0 / AS_STATED < fit.chi2 < AS_STATED:
        return None
    if len(graph.closures) and not _quietly(lambda: _any_agree(squared)):
        return None
    return (
        f"the maps' own loops fit with a normalised chi2 of {stated.chi2:.3g}, where noise as"
        " stated gives 1: is the information its square root (--information sqrt)? Read so it is"
        f" {fit.chi2:.3g}"
    )


def _own(graph: MultiRobotGraph, clean: bool) -> Sequence[PoseGraph]:
    if not clean:
        return graph.maps
    from pcm_jax.pipeline import clean_maps

    return clean_maps(graph)[0].maps


def _read_again(options: Any, robots: int) -> MultiRobotGraph:
    cut = getattr(options, "split_id", None) or getattr(options, "split", None)
    return (graph_to_merge(options) if cut and robots > 1 else read(options)).graph


def _any_agree(graph: MultiRobotGraph | None) -> bool:
    """True if PCM accepts any closure."""
    from pcm_jax.pipeline import select

    return graph is not None and bool(select(graph).accepted.any())


def _quietly(function: Any) -> Any:
    """The function's result without warnings; None where it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return function()
        except InputError:
            return None
