"""The report of a merge as one HTML page that needs nothing else: no network, no other file.

    _facts       fate and error of every closure
    _words       the answer in sentences, numbers, and what is told of a closure
    _elements    elements of HTML, all text in them escaped
    _answer      the first screen: the answer, its figures, a row for each pair of robots
    _closures    the table of closures
    _sections    the sections around the figures
    _drawings    the numbers that figures are drawn from
    _page        the document, with its style, its scripts and its policy

`page/` holds the page's style and scripts; `vendor/` the libraries that these use, whole and with
their licences, listed with versions, sources and hashes in `vendor/vendored.json`. There is no
build step: the files are put into the page as they are.
"""

from __future__ import annotations

from os import PathLike
from typing import Any

from pcm_jax.files.output import write_text
from pcm_jax.merging import MergeResult
from pcm_jax.report._page import page, vendored

__all__ = ["page", "vendored", "write_html"]


def write_html(
    path: str | PathLike[str], result: MergeResult, report: dict[str, Any] | None = None
) -> None:
    """Writes the report of a merge as one HTML page.

        pcm_jax.report.write_html("report.html", pcm_jax.merge(graph))

    Args:
        path: of the file; `.gz` and `.xz` compress.
        result: of `merge`.
        report: `result.report()`, with whatever else is known ("hints", "calibration"); itself by
            default.

    Raises:
        FileFormatError: where the file cannot be written.
    """
    write_text(path, page(result, result.report() if report is None else report))
