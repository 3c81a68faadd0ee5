"""`pcm-jax merge`: from files to one map, with a report and a picture of it."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pcm_jax.cli import _outputs as outputs
from pcm_jax.cli._hints import square_root
from pcm_jax.cli._progress import Progress
from pcm_jax.cli._summary import summary
from pcm_jax.errors import InputError

NEARLY_NONE = 0.1
"""Share of closures accepted, up to which it is asked what they may have meant."""


def run(options: Any) -> None:
    """Reads, merges, writes what was asked for and prints a summary, or the report as JSON."""
    _check_outputs(options)
    with Progress("reading") as progress:
        result, report = _merged(options, progress)
        progress("writing")
        written = list(_written(options, result, report))
    if options.json:
        print(outputs.json_text(report), end="")
        return
    print(summary(report))
    for path in written:
        print(f"wrote {path}")


def _check_outputs(options: Any) -> None:
    inputs = [*options.files, *(options.closures or [])]
    files = [options.rejected, options.report, options.html, options.plot]
    if options.output:
        from pcm_jax.cli._merged_files import check_folder, is_folder

        if is_folder(options.output):
            check_folder(options.output)
        else:
            files.insert(0, Path(options.output))
    outputs.check_outputs([path for path in files if path], inputs)
    if options.plot:
        outputs.check_picture(options.plot)


def _merged(options: Any, progress: Progress) -> tuple[Any, dict[str, Any]]:
    from pcm_jax.cli._inputs import graph_to_merge

    start = time.perf_counter()
    given = graph_to_merge(options)
    seconds = {"read": time.perf_counter() - start}
    result, cleaned, more = _merge(given.graph, options, options.clean_maps, progress)
    report = {**result.report(), **cleaned, "input": given.as_dict()}
    if options.calibrate:
        report["calibration"] = _calibration(given.graph, result, progress)
    report["hints"] = [
        *_mistakes(result, progress),
        *_hints(options, given.graph, report, progress),
    ]
    return result, {**report, "seconds": {**seconds, **more, **report["seconds"]}}


def _calibration(graph: Any, result: Any, progress: Progress) -> dict[str, Any]:
    """The factors on stated information, by closures that agree, or those that were given."""
    from pcm_jax.pipeline import calibrate

    progress("calibrating")
    accepted = None if result.selection is not None else result.accepted
    return calibrate(graph, accepted).as_dict()


def _merge(
    graph: Any, options: Any, clean: bool, progress: Progress
) -> tuple[Any, dict[str, Any], dict[str, float]]:
    """A merge as the options say; the report's rows on cleaned maps, and what they took."""
    from pcm_jax.pipeline import merge

    cleaned, seconds = {}, {}
    if clean:
        start = time.perf_counter()
        progress(f"cleaning {len(graph.maps)} maps")
        graph, cleaned["cleaned"] = _cleaned(graph, options)
        seconds["clean"] = time.perf_counter() - start
    result = merge(
        graph,
        method=options.method,
        confidence=options.confidence,
        minimum_inliers=options.minimum_inliers,
        significance=options.significance,
        separation=options.separation,
        on_ambiguous=options.on_ambiguous,
        prefer=options.prefer,
        seed=options.seed,
        time_limit=options.time_limit,
        refine=options.refine,
        progress=progress,
    )
    return result, cleaned, seconds


def _hints(options: Any, graph: Any, report: dict[str, Any], progress: Progress) -> Iterator[str]:
    """Options that mend a fit that cannot be meant: each is tried on the data before it is named.

    The information's square root must fit as stated noise does (see `_hints`); cleaned maps must
    fit ten times better.
    """
    chi2 = report["solution"]["normalized_chi2"]
    from pcm_jax.merging import TOO_BAD

    told = square_root(options, graph, progress, clean=options.clean_maps)
    if told is not None:
        yield told
    if chi2 is not None and chi2 > TOO_BAD and not options.clean_maps:
        found = _when_cleaned(options, graph, progress)
        if found is not None and found < 0.1 * chi2:
            yield (
                f"the normalised chi2 is {chi2:.3g}, where noise as stated gives 1: do the robots'"
                f" own maps hold false loops (--clean-maps)? Without them it is {found:.3g}"
            )


def _mistakes(result: Any, progress: Progress) -> Iterator[str]:
    """The usual mistake that explains why nearly every closure is rejected."""
    from pcm_jax.integrity import triage

    chosen = result.selection
    if chosen is None or result.accepted.mean() > NEARLY_NONE:
        return
    progress("trying what closures may mean")
    with contextlib.suppress(InputError):
        found = triage(chosen.evidence, chosen.gate)
        if found is not None:
            yield f"nearly every closure is rejected; {found.sentence}"


def _when_cleaned(options: Any, graph: Any, progress: Progress) -> float | None:
    """Chi-squared of a merge of cleaned maps, None where that cannot be done."""
    progress("trying cleaned maps")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            result, _, _ = _merge(graph, options, True, progress)
        except InputError:
            return None
    return result.report()["solution"]["normalized_chi2"]


def _cleaned(graph: Any, options: Any) -> tuple[Any, list[dict[str, Any]]]:
    """The graph without the closures inside its maps that PCM rejects, and the report's rows."""
    from pcm_jax.pipeline import clean_maps

    given = {
        "confidence": options.confidence,
        "time_limit": options.time_limit,
        "significance": options.significance,
        "seed": options.seed,
    }
    limits = {name: value for name, value in given.items() if value is not None}
    clean, selections = clean_maps(graph, **limits)
    return clean, list(map(_cleaned_row, graph.maps, selections))


def _cleaned_row(pose_graph: Any, selection: Any) -> dict[str, Any]:
    """Says what was decided of one map; one without a loop has no selection."""
    rejected = [] if selection is None else (~selection.kept).nonzero()[0].tolist()
    closures = 0 if selection is None else len(selection.closures)
    return {
        "robot": pose_graph.name,
        "measured": closures,
        "accepted": closures - len(rejected),
        "optimal": selection is None or selection.optimal,
        "upper_bound": 0 if selection is None else selection.upper_bound,
        **_judged(selection),
        "rejected": [
            {
                "a": pose_graph.pose_name(int(pose_graph.tail[edge])),
                "b": pose_graph.pose_name(int(pose_graph.head[edge])),
                "source": str(pose_graph.source[edge]),
            }
            for edge in rejected
        ],
    }


def _judged(selection: Any) -> dict[str, Any]:
    """The fields of a cleaned map's row that say why its closures are believed."""
    if selection is None:
        return {"odometry_scale": 1.0, "found": 0, "places": 0, "chance": None, "why": None}
    verdict = selection.verdict
    return {
        "odometry_scale": selection.odometry_scale,
        "found": verdict.found,
        "places": verdict.places,
        "chance": verdict.chance.p_value if verdict.chance else None,
        "why": verdict.why,
    }


def _written(options: Any, result: Any, report: dict[str, Any]) -> Any:
    """Writes the files asked for, and gives their paths."""
    from pcm_jax.cli._merged_files import write_merged, write_rejected
    from pcm_jax.files.output import write_text

    if options.output:
        yield from write_merged(options.output, result)
    if options.rejected:
        write_rejected(options.rejected, result)
        yield options.rejected
    if options.report:
        write_text(options.report, outputs.json_text(report))
        yield options.report
    if options.html:
        from pcm_jax.report import write_html

        write_html(options.html, result, report)
        yield options.html
    if options.plot:
        outputs.save_picture(options.plot, result.plot())
        yield options.plot
