"""Real drives cut in two at every so many poses: which cuts are merged, rightly or wrongly.

    python -m benchmarks.cuts [--data DIR] --out DIR [--datasets NAME...] [--every 100]
                              [--maps odometry cleaned]

Each cut makes two robots of one drive; the candidates of a real front end across the cut are the
closures between them (`benchmarks.experiments.real_candidates`). Where the world repeats itself the
largest set that agrees may be wrong. A cut is *right* if most of its largest set is, and a rule

    2         two closures suffice
    chance    the set has to stand out from chance (`integrity.chance`)
    default   and must have no rival about as good (`integrity.rivals`)
    20 m      as default, `separation=20`: closures within 20 m along both ways are one witness

merges it or not. What counts: cuts that are wrong and merged, and the share of right ones that is.

Writes summary.json ({data set, maps: {rule: figures}}), cuts.json (each cut), table.md, run.json.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.experiments import real_candidates as real
from benchmarks.experiments.command import command_parser, finish, run_tasks
from benchmarks.experiments.record import LIBRARY
from benchmarks.place_recognition import across, load, sessions
from benchmarks.suite.harness import DATA
from pcm_jax import InputWarning, select, weigh
from pcm_jax.arrays import on_host
from pcm_jax.experiments import drives
from pcm_jax.store import Store, digest, write_json

RULES: dict[str, dict[str, Any]] = {
    "2": {"minimum_inliers": 2},
    "chance": {"on_ambiguous": "largest", "prefer": "closures"},
    "default": {},
    "20 m": {"separation": 20.0},
}
COLUMNS = {
    "right": "right",
    "right_merged": "of them merged",
    "wrong": "wrong",
    "wrong_merged": "of them merged",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command."""
    parser = command_parser("cuts", __doc__)
    parser.add_argument("--data", type=Path, default=DATA, help="with kitti_robust or rrr in it")
    parser.add_argument("--datasets", nargs="+", metavar="NAME", help="default: all found")
    parser.add_argument("--every", type=int, default=100, metavar="POSES")
    parser.add_argument("--maps", nargs="+", default=["odometry", "cleaned"])
    options = parser.parse_args(arguments)
    start = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    sources = [*LIBRARY, Path(__file__), Path(real.__file__)]
    steps = Store(options.out / "steps", digest(options.data.name, files=sources))
    tasks = {
        f"{name}, {maps}, {cut}": partial(judged, options.data, name, maps, cut)
        for name in options.datasets or drives.found(options.data)
        for maps in options.maps
        for cut in range(options.every, load(options.data, name).graph.num_poses, options.every)
    }
    found = run_tasks("cuts", tasks, steps, jobs=options.jobs)
    summary = counted(found)
    rows = {
        f"{kind}, {rule}": own for kind, rules in summary.items() for rule, own in rules.items()
    }
    write_json(options.out / "cuts.json", found)
    return finish(options, start, summary, rows, COLUMNS)


@on_host
def judged(data: Path, name: str, maps: str, cut: int) -> dict[str, Any]:
    """The answer of every rule on one cut; no rules where no two closures agree."""
    candidates = load(data, name)
    right = candidates.is_true[across(candidates.graph, cut)]
    about = {"kind": f"{name}, {maps}", "closures": len(right), "right": int(right.sum())}
    if len(right) < 2:
        return about | {"rules": {}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        evidence = weigh(sessions(candidates.graph, cut, maps))
        selections = {rule: select(evidence, **options) for rule, options in RULES.items()}
    (largest,) = selections["2"].pairs
    if not largest.accepted.any():
        return about | {"rules": {}}
    true = int((largest.accepted & right).sum())
    (pair,) = selections["default"].pairs
    return about | {
        "set": largest.found,
        "set_right": true,
        "is_right": 2 * true > largest.found,
        "why": pair.verdict.why,
        "rules": {rule: bool(chosen.accepted.any()) for rule, chosen in selections.items()},
    }


def counted(found: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, dict[str, int]]]:
    """Cuts that are right or wrong, and merged, by kind and rule."""
    summary: dict[str, dict[str, dict[str, int]]] = {}
    for cut in found.values():
        for rule, merged in cut["rules"].items():
            rules = summary.setdefault(cut["kind"], {})
            own = rules.setdefault(rule, dict.fromkeys(COLUMNS, 0))
            side = "right" if cut["is_right"] else "wrong"
            own[side] += 1
            own[f"{side}_merged"] += int(merged)
    return summary


if __name__ == "__main__":
    raise SystemExit(main())
