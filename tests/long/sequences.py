"""Sequences of steps: closures come and go, maps grow, states are saved and loaded.

    python -m tests.long.sequences --count 10000

The state machine of `tests/online/test_stateful.py` compares with the batch after each step. Here
it runs ten steps, is asked for its answer after some of them, and is compared at the end, which is
what ten thousand sequences take hours for otherwise. Of a hundred sequences the first is compared
after each step. A run goes on after those in its log, by `--first`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from ._log import LOGS, ROOT, commit, found_in, machine, table

sys.path[:0] = [str(ROOT / "tests" / "online"), str(ROOT / "tests")]
EACH = 100
"""Sequences of which one is compared after each step."""
STEPS = 10


def machine_of(told: Counter[str]) -> type:
    """The state machine that compares at the end and counts what it did."""
    from hypothesis.stateful import invariant, precondition
    from test_stateful import Steps

    class Sequence(Steps):
        @precondition(lambda self: hasattr(self, "online"))
        @invariant()
        def equal(self) -> None:
            told["steps"] += 1
            if told["sequences"] % EACH == 0:
                told["compared on the way"] += 1
                Steps.equal(self)
            elif told["steps"] % 3 == 0:
                self.online.result()

        def teardown(self) -> None:
            if hasattr(self, "online"):
                Steps.equal(self)
                told["sequences"] += 1
                told["accepted"] += int(self.online.result().accepted.any())

    return Sequence


def run(first: int, count: int, deadline: float = float("inf")) -> dict[str, Any]:
    """Runs sequences in hundreds by seeds; gives counts, and the seeds at which one differed."""
    import jax
    from hypothesis import HealthCheck, Phase, settings
    from hypothesis import seed as seeded
    from hypothesis.stateful import run_state_machine_as_test

    told: Counter[str] = Counter()
    found: list[str] = []
    chosen = settings(
        max_examples=EACH,
        stateful_step_count=STEPS,
        phases=(Phase.generate,),
        database=None,
        deadline=None,
        suppress_health_check=tuple(HealthCheck),
    )
    began = time.perf_counter()
    with jax.enable_x64(True):
        number = first
        while told["sequences"] < count and time.monotonic() < deadline:
            try:
                run_state_machine_as_test(seeded(number)(machine_of(told)), settings=chosen)
            except Exception as error:  # whatever it is, it is to be told
                found.append(f"seed {number}: {type(error).__name__}: {str(error)[:200]}")
            number += 1
    return {"told": told, "found": found, "next": number, "seconds": time.perf_counter() - began}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.sequences", description=__doc__)
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0, help="seed of the first hundred")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--out", type=Path, default=LOGS / "sequences.md")
    given = parser.parse_args()
    done = run(given.first, given.count, time.monotonic() + 60 * given.minutes)
    told = done["told"]
    rows: list[list[object]] = [[name, told[name]] for name in sorted(told)]
    given.out.write_text(
        f"# Sequences of steps\n\n`python -m tests.long.sequences --first {given.first} --count"
        f" {told['sequences']}`, seeds {given.first} to {done['next'] - 1}. Commit {commit()};"
        f" {machine()}; {done['seconds']:.0f} s.\n\n"
        + table(["of", "count"], rows)
        + found_in(done["found"])
    )
    sys.stderr.write(given.out.read_text())


if __name__ == "__main__":
    main()
