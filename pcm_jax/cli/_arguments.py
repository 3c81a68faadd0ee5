"""The options of all commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from pcm_jax import __version__
from pcm_jax.cli._evaluate_arguments import add_evaluate_options
from pcm_jax.cli._stream_arguments import add_stream_options
from pcm_jax.cli._values import minimum_inliers, positive, seconds

DEMO_PICTURE = Path("pcm-jax-demo.png")
DEMO_PAGE = Path("pcm-jax-demo.html")

# Options that `simulate city` and `simulate sessions` share; defaults are the library's.
_WORLD = {
    "--poses": (int, "N", "poses of each robot"),
    "--inliers": (int, "N", "true closures between each two robots"),
    "--aliased-groups": (int, "N", "groups of false closures that agree among themselves"),
    "--aliased-size": (int, "N", "closures in each of these groups"),
    "--random": (int, "N", "random closures between each two robots"),
    "--random-range": (float, "M", "metres between the ends of a random closure"),
    "--sigma-translation": (float, "M", "standard deviation of measured translations, metres"),
    "--sigma-rotation": (float, "RAD", "standard deviation of measured rotations, radians"),
    "--reach": (float, "M", "metres between two poses that can measure each other"),
}
_CITY = {
    "--robots": (int, "N", "number of robots"),
    "--blocks": (int, "N", "blocks of 5 m along each side of the city"),
}
_SESSIONS = {
    "--sessions": (int, "N", "number of drives"),
    "--closure-sigma-translation": (float, "M", "the same of closures, metres"),
    "--closure-sigma-rotation": (float, "RAD", "the same of closures, radians"),
}


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage in front of it."""

    def __init__(self, **options: Any):
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message} (see {self.prog} --help)\n")


def parser() -> argparse.ArgumentParser:
    """The parser of `pcm-jax`; the options it returns name the `command` to run."""
    top = _Parser(
        prog="pcm-jax",
        description="Merge the pose graphs of several robots by the largest pairwise consistent "
        "set of loop closures between them.",
        epilog="Exit status: 0, or 2 for bad input, with one line that says what is wrong.",
    )
    top.add_argument("--version", action="version", version=f"pcm-jax {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _demo(commands)
    _merge(commands)
    _inspect(commands)
    _explain(commands)
    _calibrate(commands)
    _stream(commands)
    _evaluate(commands)
    _command(commands, "formats", "List the file formats and what is kept of each.")
    _simulate(commands)
    return top


def _command(commands: Any, name: str, summary: str) -> argparse.ArgumentParser:
    return commands.add_parser(name, help=summary, description=summary)


def _seed(command: argparse.ArgumentParser, meaning: str, default: Any = 0) -> None:
    command.add_argument("--seed", type=int, metavar="N", default=default, help=meaning)


def _demo(commands: Any) -> None:
    demo = _command(
        commands,
        "demo",
        "Simulate two robots with 15 true and 100 false closures; merge them with all and by PCM. "
        f"Writes {DEMO_PICTURE} and {DEMO_PAGE}.",
    )
    _seed(demo, "of the simulated world (default: 0)")


def _merge(commands: Any) -> None:
    merge = _command(commands, "merge", "Merge the robots' maps in pose-graph files.")
    _files(merge)
    cut = merge.add_mutually_exclusive_group()
    cut.add_argument(
        "--split",
        nargs="+",
        metavar="POSE",
        help="cut one trajectory into robots a, b, ... before these poses (0, 1, ... in the order "
        "of ids); its loop closures across the cuts become the candidates; or 'components': make "
        "a robot of each session that no odometry links to another",
    )
    cut.add_argument(
        "--split-id",
        type=int,
        nargs="+",
        metavar="ID",
        help="the same before the poses with these ids",
    )
    merge.add_argument(
        "--method",
        default="pcm-exact",
        help="pcm-exact, pcm-heuristic, combinatorial, ransac, scgp, clipper, jcbb; dcs, gnc, "
        "switchable or max-mixture (all closures, scaled); or all (default: %(default)s)",
    )
    merge.add_argument(
        "--confidence",
        type=float,
        metavar="P",
        help="probability that two right closures pass the gate (default: 0.99)",
    )
    merge.add_argument(
        "--minimum-inliers",
        type=minimum_inliers,
        metavar="chance|N",
        help="chance: two robots are merged if closures of which none is right would hardly agree "
        "as well as those that do; N: if as many closures agree (default: chance; 2 for robust "
        "methods)",
    )
    merge.add_argument(
        "--significance",
        type=float,
        metavar="P",
        help="probability that any two robots are merged none of whose closures is right, see "
        "--minimum-inliers chance (default: 0.01)",
    )
    merge.add_argument(
        "--separation",
        type=float,
        metavar="M",
        help="metres along the way of either robot from which on closures count as two witnesses "
        "(default: the longest run of closures that agree with each other, not with those found)",
    )
    merge.add_argument(
        "--on-ambiguous",
        choices=("split", "largest"),
        help="where two alignments are supported about as well: leave the two robots apart, or "
        "take the larger set (default: split)",
    )
    merge.add_argument(
        "--prefer",
        choices=("places", "closures"),
        help="of two such sets the larger one is that at more places, of as many that of more "
        "closures; or that of more closures, wherever they lie (default: places)",
    )
    merge.add_argument(
        "--refine",
        choices=("recall", "gnc"),
        help="recall: closures that were left out, but agree with the merged map, come back; gnc: "
        "before that, graduated non-convexity judges all of them and the loops inside the maps, "
        "from the merged map (default: neither)",
    )
    merge.add_argument(
        "--time-limit",
        type=seconds,
        metavar="S",
        help="seconds for each robot pair's clique search (and each map's, see --clean-maps)",
    )
    merge.add_argument(
        "--clean-maps",
        action="store_true",
        help="before that, drop loop closures inside each robot's own map by PCM, at the same "
        "confidence: those that disagree with its odometry or among themselves",
    )
    merge.add_argument(
        "--calibrate",
        action="store_true",
        help="say in the report and below the table by which factors the stated information is off",
    )
    _reading(merge)
    merge.add_argument(
        "--output",
        metavar="FILE",
        help="write the merged maps and the accepted closures, as g2o or what the suffix says "
        "(.jrl, .json), a file for each group of robots; or DIR/, files for each robot",
    )
    for name, what in (
        ("rejected", "the candidates that were not accepted, as CSV"),
        ("report", "what was accepted, and how well it fits, as JSON"),
        ("html", "the same as one page to read: maps, closures, why each was accepted or not"),
        ("plot", "a picture of the merged maps"),
    ):
        merge.add_argument(f"--{name}", type=Path, metavar="FILE", help=f"write {what}")
    merge.add_argument(
        "--json", action="store_true", help="print the report as JSON instead of text"
    )
    _seed(merge, "of the shuffles that --minimum-inliers chance makes (default: 0)", None)


def _inspect(commands: Any) -> None:
    inspect = _command(commands, "inspect", "Say what pose-graph files hold and what is odd.")
    _files(inspect)
    inspect.add_argument(
        "--split", choices=("components",), help="make a robot of each session in a file"
    )
    inspect.add_argument("--json", action="store_true", help="print JSON instead of text")
    _reading(inspect)


def _explain(commands: Any) -> None:
    explain = _command(
        commands,
        "explain",
        "Say why a closure was accepted or rejected, from the report of a merge.",
    )
    explain.add_argument(
        "report", type=Path, metavar="REPORT", help="what pcm-jax merge --report wrote"
    )
    explain.add_argument(
        "closure", type=int, metavar="CLOSURE", help="its index in the report, from 0 on"
    )
    explain.add_argument("--json", action="store_true", help="print JSON instead of text")


def _stream(commands: Any) -> None:
    stream = _command(
        commands,
        "stream",
        "Take the closures in files one after another, as a robot would meet them, and print a "
        "line whenever it changes which of them are believed.",
    )
    _files(stream)
    add_stream_options(stream)
    _seed(stream, "of the shuffles that --minimum-inliers chance makes (default: 0)", None)
    _reading(stream)


def _evaluate(commands: Any) -> None:
    evaluate = _command(
        commands,
        "evaluate",
        "Compare trajectories with the truth: absolute and relative errors (ATE, RPE) of each "
        "robot and of all, as evo defines them.",
    )
    add_evaluate_options(evaluate)
    _ids(evaluate)


def _calibrate(commands: Any) -> None:
    calibrate = _command(
        commands,
        "calibrate",
        "Say by which factors the stated information of odometry and of closures is off, from "
        "loops inside the maps and closures between robots that agree.",
    )
    _files(calibrate)
    calibrate.add_argument(
        "--split", choices=("components",), help="make a robot of each session in a file"
    )
    calibrate.add_argument(
        "--drift",
        type=positive,
        nargs=2,
        metavar=("PERCENT", "DEG_PER_M"),
        help="odometry's error after 100 m, in place of the information that files state",
    )
    calibrate.add_argument(
        "--closure-sigmas",
        type=positive,
        nargs=2,
        metavar=("M", "RAD"),
        help="standard deviations of closures, in place of the information that files state",
    )
    calibrate.add_argument(
        "--confidence",
        type=float,
        metavar="P",
        default=0.99,
        help="probability that two right closures pass the gate (default: %(default)s)",
    )
    calibrate.add_argument(
        "--output", type=Path, metavar="FILE", help="write the rescaled graph, as g2o"
    )
    calibrate.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="write a picture of residuals against what they should be",
    )
    calibrate.add_argument("--json", action="store_true", help="print JSON instead of text")
    _seed(calibrate, "of simulated errors (default: 0)")
    _reading(calibrate)


def _simulate(commands: Any) -> None:
    simulate = _command(
        commands, "simulate", "Write simulated maps, candidate closures and which of them are true."
    )
    worlds = simulate.add_subparsers(dest="world", required=True, metavar="WORLD")
    for world, summary, options in (
        ("city", "Robots in one city of square blocks, SE(2).", _CITY),
        ("sessions", "Drives over one rolling campus, SE(3).", _SESSIONS),
    ):
        command = _command(worlds, world, summary)
        command.add_argument(
            "--output", type=Path, required=True, metavar="DIR", help="folder, made if need be"
        )
        command.add_argument(
            "--csv",
            action="store_true",
            help="one plain g2o file per robot and a CSV file of candidates, not one g2o file",
        )
        _seed(command, "the same seed gives the same world (default: 0)")
        for option, (kind, metavar, meaning) in {**_WORLD, **options}.items():
            command.add_argument(
                option, type=kind, metavar=metavar, help=meaning, default=argparse.SUPPRESS
            )


def _files(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "files",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="a pose graph or trajectory, plain, .gz or .xz (see: pcm-jax formats)",
    )
    command.add_argument(
        "--closures",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="further candidate closures: CSV, or any graph file, whose edges they are",
    )


def _reading(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--information",
        choices=("as-written", "sqrt", "covariance"),
        default="as-written",
        help="whether the files hold the information, its square root or its inverse (default: "
        "%(default)s)",
    )
    _ids(command)
    command.add_argument(
        "--default-sigmas",
        "--sigmas",
        type=float,
        nargs=2,
        metavar=("M", "RAD"),
        help="standard deviations of edges without information, and of a trajectory's steps",
    )
    command.add_argument(
        "--repair", choices=("clip",), help="clip information that is not positive definite"
    )
    command.add_argument(
        "--skip-bad", action="store_true", help="leave out candidates that cannot be read"
    )
    command.add_argument(
        "--byte-limit",
        type=int,
        metavar="BYTES",
        help="bytes that one file may have after decompression (default: 1 GiB)",
    )
    command.add_argument(
        "--ignore-priors", action="store_true", help="leave out poses measured by themselves"
    )


def _ids(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--ids",
        choices=("auto", "per-file", "shared", "symbols"),
        default="auto",
        help="whose poses the files' ids are (default: %(default)s)",
    )
