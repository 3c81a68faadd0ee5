"""The options of `pcm-jax stream` alone."""

from __future__ import annotations

import argparse
from pathlib import Path

from pcm_jax.cli._values import at_least_one, minimum_inliers


def add_stream_options(stream: argparse.ArgumentParser) -> None:
    """Adds the order of closures, when and how answers are told, and the rule they follow."""
    stream.add_argument(
        "--split",
        nargs="+",
        metavar="POSE",
        help="cut one trajectory into robots before these poses, or 'components', as in merge",
    )
    stream.add_argument("--split-id", type=int, nargs="+", metavar="ID", help="likewise by ids")
    stream.add_argument(
        "--order",
        choices=("auto", "stamps", "lines"),
        default="auto",
        help="stamps: a closure comes with the later of its two poses; lines: as files list them; "
        "auto: by stamps where all poses that closures touch have them (default: %(default)s)",
    )
    stream.add_argument(
        "--every",
        type=at_least_one,
        metavar="N",
        default=1,
        help="ask for the answer after every N closures, and at the end (default: %(default)s)",
    )
    stream.add_argument(
        "--follow",
        action="store_true",
        help="when all is read, wait for the files to grow, and go on; robots may come",
    )
    stream.add_argument(
        "--patience",
        type=float,
        metavar="S",
        help="with --follow: end when no file has grown for S seconds (default: never)",
    )
    stream.add_argument(
        "--confidence",
        type=float,
        metavar="P",
        default=0.99,
        help="probability that two right closures pass the gate (default: %(default)s)",
    )
    stream.add_argument(
        "--minimum-inliers",
        type=minimum_inliers,
        metavar="chance|N",
        default="chance",
        help="when a pair of robots is believed, as in merge (default: %(default)s)",
    )
    stream.add_argument(
        "--significance", type=float, metavar="P", help="of chance, as in merge (default: 0.01)"
    )
    stream.add_argument(
        "--separation", type=float, metavar="M", help="metres between witnesses, as in merge"
    )
    stream.add_argument(
        "--save", type=Path, metavar="FILE", help="write the state, to go on from, at the end"
    )
    stream.add_argument("--json", action="store_true", help="print a JSON object a line")
