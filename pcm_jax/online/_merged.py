"""The maps merged by the closures that are believed now."""

from __future__ import annotations

import dataclasses
from typing import Any

from pcm_jax.errors import InputError
from pcm_jax.merging import MergeResult
from pcm_jax.selection import Selection

OF_MERGING = ("solver", "engine", "refine", "progress")


def merged_by(selection: Selection, options: dict[str, Any]) -> MergeResult:
    """Merges the maps of an answer, as `merge` of the same graph does.

    Args:
        selection: the answer.
        options: `solver`, `engine`, `refine` and `progress` of `merge`.

    Raises:
        InputError: as `merge`, and for other options.
    """
    from pcm_jax.pipeline import merge

    for name in options:
        if name not in OF_MERGING:
            expected = ", ".join(OF_MERGING)
            raise InputError(f"{name}: not an option of merge here, expected one of {expected}")
    if options.get("refine") is not None:
        options = {**options, "confidence": selection.confidence}
    merged = merge(selection.evidence, accepted=selection.accepted, **options)
    return dataclasses.replace(
        merged,
        selection=selection,
        method=selection.method,
        confidence=selection.confidence,
        gate=selection.gate,
        seconds=merged.seconds | selection.seconds,
    )
