"""`pcm-jax calibrate`: how honest the covariances in pose-graph files are, and by which factors."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.cli import _outputs as outputs
from pcm_jax.cli._inputs import read
from pcm_jax.cli._progress import Progress
from pcm_jax.graph import MultiRobotGraph, PoseGraph
from pcm_jax.tables import columns_of_text

SEGMENT = 100.0
"""Metres over which drift is told: the shortest segment of KITTI's evaluation."""


def run(options: Any) -> None:
    """Reads, calibrates, writes what was asked for and prints factors and advice."""
    targets = [path for path in (options.output, options.plot) if path]
    outputs.check_outputs(targets, [*options.files, *(options.closures or [])])
    if options.plot:
        outputs.check_picture(options.plot)
    from pcm_jax.pipeline import calibrate

    with Progress("reading") as progress:
        graph = read(options).graph
        graph = without_covariances(graph, options.drift, options.closure_sigmas)
        progress("calibrating")
        found = calibrate(graph, confidence=options.confidence, seed=options.seed)
    if options.output:
        from pcm_jax.files import write_g2o

        write_g2o(options.output, found.apply(graph))
    if options.plot:
        from pcm_jax.plots import plot_calibration

        outputs.save_picture(options.plot, plot_calibration(found))
    if options.json:
        print(outputs.json_text(found.as_dict()), end="")
        return
    print(summary(found, graph))
    for path in targets:
        print(f"wrote {path}")


def summary(found: Any, graph: MultiRobotGraph) -> str:
    """A calibration as the text that the command prints."""
    rows = [
        [kind, half, *_numbers(factor)]
        for kind, factors in (("odometry", found.odometry), ("closures", found.closures))
        for half, factor in factors._asdict().items()
    ]
    factors = columns_of_text(["edges", "errors in", "information times", "90 % interval"], rows)
    maps = columns_of_text(
        ["robot", "its own loops, normalised chi2"],
        [
            [name, "no loops" if chi2 is None else f"{chi2:.4g}"]
            for name, chi2 in zip(graph.names, found.map_consistency, strict=True)
        ],
    )
    return "\n\n".join([factors, maps, str(found)])


def _numbers(factor: Any) -> list[str]:
    if not factor.known:
        return ["unknown", ""]
    low, high = factor.interval
    return [f"{float(factor):.4g}", f"{low:.4g} to {high:.4g}"]


def without_covariances(
    graph: MultiRobotGraph,
    drift: tuple[float, float] | None,
    closure_sigmas: tuple[float, float] | None,
) -> MultiRobotGraph:
    """Puts in place of stated information what is said of drift and of closures.

    Drift is the error after 100 m, in per cent of the way and in degrees per metre, as KITTI tells
    it. Steps err independently, so that a step of L metres has the standard deviations
    percent/100 · √(100 m · L) and (degrees a metre) · √(100 m · L).

    Args:
        graph: as read.
        drift: per cent, degrees per metre; None: odometry as stated.
        closure_sigmas: metres, radians; None: closures as stated.
    """
    from pcm_jax.integrity.calibration import closing_edges

    def of(one: PoseGraph) -> PoseGraph:
        information, closing = np.array(one.information), closing_edges(one)
        steps = np.linalg.norm(lie.translation(lie.as_numpy(one.measurement)), axis=1)
        steps = np.maximum(steps, 0.01 * steps[~closing].mean() if (~closing).any() else 1.0)
        if drift is not None:
            root = np.sqrt(SEGMENT * steps[~closing])
            sigmas = 0.01 * drift[0] * root, np.radians(drift[1]) * root
            information[~closing] = _diagonal(*sigmas, one.tangent_dim)
        if closure_sigmas is not None:
            information[closing] = _diagonal(*closure_sigmas, one.tangent_dim)
        return dataclasses.replace(one, information=information)

    between = graph.closures
    if closure_sigmas is not None and len(between):
        alike = _diagonal(*closure_sigmas, graph.tangent_dim)
        shape = np.asarray(between.information).shape
        between = dataclasses.replace(between, information=np.broadcast_to(alike, shape).copy())
    return dataclasses.replace(graph, maps=tuple(map(of, graph.maps)), closures=between)


def _diagonal(translation: Any, rotation: Any, d: int) -> np.ndarray:
    """Information `[…, d, d]` of standard deviations."""
    half = d - 1 if d == 3 else 3
    sigmas = [translation] * half + [rotation] * (d - half)
    return np.stack(sigmas, axis=-1)[..., None] ** -2 * np.eye(d)
