"""The options of `pcm-jax evaluate` alone."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_evaluate_options(evaluate: argparse.ArgumentParser) -> None:
    """Adds the files to compare, how they are brought together, and what a step is."""
    kinds = "a pose graph with all robots, or files of each (see: pcm-jax formats)"
    evaluate.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help=f"the estimate: {kinds}"
    )
    evaluate.add_argument(
        "--truth",
        type=Path,
        nargs="+",
        metavar="FILE",
        required=True,
        help=f"the true poses: {kinds}",
    )
    evaluate.add_argument(
        "--align",
        choices=("joint", "each", "none"),
        default="joint",
        help="one rigid motion of all robots into the truth's frame, one of each, or none "
        "(default: %(default)s)",
    )
    step = evaluate.add_mutually_exclusive_group()
    step.add_argument(
        "--delta",
        type=int,
        metavar="N",
        default=1,
        help="frames in a step of the relative error (default: %(default)s)",
    )
    step.add_argument(
        "--delta-metres", type=float, metavar="M", help="metres in a step instead, as travelled"
    )
    evaluate.add_argument(
        "--max-difference",
        type=float,
        metavar="S",
        default=0.01,
        help="seconds by which the time stamps of one pose may differ (default: %(default)s)",
    )
    evaluate.add_argument("--json", action="store_true", help="print JSON instead of text")
