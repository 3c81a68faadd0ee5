"""`select_within`: the loop closures inside one robot's own map to believe.

Between two robots nothing says beforehand where one is from the other, and the largest consistent
set is all there is to go by. Inside one map odometry says it for every closure by itself. So a
closure must agree with odometry alone as well as with the others (`own_loop`): by the gate, that
costs right closures no more than one pair does, and it rejects groups of false ones that agree
among themselves, however large, as soon as they contradict odometry.

Odometry that states its errors too small contradicts right closures as well. Where a larger scale
of its errors, estimated from the closures (`integrity.odometry`), lets clearly more of them agree,
they are judged under that; but if it drops those that agree with odometry as stated, only if these
are not beyond chance: many false closures that say the same are no scale. What is found is accepted
if chance hardly does as well (`integrity.within`): under a fitted scale by shuffles that are fitted
too, at half the level; as stated by either test, at half of what is left each.

The larger the largest set, the more right closures it leaves out, of which one pair in a hundred
fails the gate; those that the cleaned map agrees with come back (`_within_recall`). Where odometry
says little, false closures agree with all others; with `recheck` the map judges them as it grows
(`_within_recheck`).
"""

from __future__ import annotations

from typing import Any

from pcm_jax.arrays import on_host
from pcm_jax.consistency import odometry_edges
from pcm_jax.errors import check_class
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.integrity import SIGNIFICANCE
from pcm_jax.pipeline.select import CHANCE, check_minimum
from pcm_jax.pipeline.within_decision import Question, check_numbers, decided, given
from pcm_jax.pipeline.within_trials import Trials
from pcm_jax.selection.choose import Method
from pcm_jax.selection.within_one_map import WithinSelection


@on_host
def select_within(
    pose_graph: PoseGraph,
    *,
    confidence: float = 0.99,
    method: Method = "pcm-exact",
    own_loop: bool = True,
    odometry_scale: float | None = None,
    minimum_inliers: int | str = CHANCE,
    significance: float | None = None,
    separation: float | None = None,
    recheck: bool = False,
    recall: bool | None = None,
    time_limit: float | None = None,
    seed: int | None = None,
    **options: Any,
) -> WithinSelection:
    """Selects the loop closures to believe inside one map.

        cleaned = pcm_jax.select_within(graph.maps[0])
        cleaned.accepted, cleaned.graph
        cleaned.verdict.why                     # in a sentence

    Squared distances are measured in the map that odometry alone gives, with its covariance as the
    edges state it or, where that contradicts what the closures have in common, a multiple of it.
    Priors of the map are kept and play no part in this.

    Args:
        pose_graph: a chain of odometry, one edge from each pose to the next in either direction
            (the first of several; others are closures), and closures, which are all other edges.
        confidence: probability that the loop of two right closures passes the gate, and that of
            one with odometry.
        method: see `select_from`.
        own_loop: whether a closure must agree with odometry by itself too. Without that, two that
            agree with each other suffice.
        odometry_scale: the factor on the standard deviations that odometry states; None: as stated,
            or what the closures themselves say if that is more (under `own_loop`). Not right where
            odometry is better than stated: 1 is then used, which tests less sharply than could be.
        minimum_inliers: "chance": what is found is accepted if closures of which none is right
            would hardly agree as well, see `integrity.within`; or a number: if that many are found.
        significance: with "chance": the probability that any is accepted where none is right; 0.01
            by default.
        separation: metres along the way between closures that are two witnesses, see
            `integrity.places`; by default as there.
        recheck: whether the map judges each closure of the largest set as it grows, and those that
            it contradicts leave. For odometry so uncertain that closures far apart agree whatever
            they say, as in most public graphs in space; takes 2 to 40 ms a closure. Where most of
            the set fits far better than stated its gates are narrower, `consistency.overstated`:
            of two sensors of which one, the busier, states errors a hundred times too large, most
            closures of the other leave; of ten times too large none.
        recall: whether closures that the largest set leaves out come back where the map that it
            makes agrees with them; None: with "chance" and `own_loop`.
        time_limit: seconds for the method, if it has the option: 60 by default, `math.inf` for any
            time. Whether it sufficed is `optimal`.
        seed: of what chance draws, 0 by default; the same seed gives the same answer.
        **options: the method's own, see `select_from`.

    Returns:
        the selection, with the cleaned map; float64 whatever the caller's `jax_enable_x64`.

    Raises:
        InputError: for consecutive poses that no edge joins, an unknown method or option, a
            confidence or significance outside (0, 1), a negative minimum or separation, a scale
            that is not above 0.
    """
    check_class("pose_graph", pose_graph, "a PoseGraph", PoseGraph)
    question = Question(
        confidence=confidence,
        method=method,
        own_loop=own_loop,
        odometry_scale=odometry_scale,
        minimum_inliers=minimum_inliers,
        significance=significance,
        separation=separation,
        recheck=recheck,
        recall=recall,
        time_limit=time_limit,
        seed=seed,
        options=options,
    )
    return decided(pose_graph, question, Trials)


def clean_maps(
    graph: MultiRobotGraph, *, significance: float | None = None, **options: Any
) -> tuple[MultiRobotGraph, tuple[WithinSelection | None, ...]]:
    """Cleans every robot's map by `select_within`; closures between robots stay as they are.

        graph, selections = pcm_jax.clean_maps(graph)

    Args:
        graph: the robots' maps.
        significance: the probability that any map accepts closures of which none is right, all maps
            together; 0.01 by default.
        **options: of `select_within`.

    Returns:
        The graph of the cleaned maps, and each map's selection; None for a map without a loop,
        which is left alone.

    Raises:
        InputError: as `select_within`.
    """
    check_class("graph", graph, "a MultiRobotGraph", MultiRobotGraph)
    looped = [each.num_edges >= each.num_poses for each in graph.maps]
    for each, has_loops in zip(graph.maps, looped, strict=True):
        if has_loops:
            odometry_edges(each)  # raises for any map before the first one takes its time
    minimum = options.get("minimum_inliers", CHANCE)
    check_minimum(minimum, given(significance=significance))
    check_numbers(significance=significance)
    if minimum == CHANCE:
        level = SIGNIFICANCE if significance is None else significance
        options["significance"] = level / max(1, sum(looped))
    selections = tuple(
        select_within(each, **options) if has_loops else None
        for each, has_loops in zip(graph.maps, looped, strict=True)
    )
    maps = tuple(
        each if selection is None else selection.graph
        for each, selection in zip(graph.maps, selections, strict=True)
    )
    return MultiRobotGraph(maps, graph.closures), selections
