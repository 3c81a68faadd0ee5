"""Silence of the triage: worlds without any mistake in how they are written, of which it names one.

    python -m benchmarks.silence --worlds 200 --out DIR

World by world in either group: two maps of 40 poses, 0 to 10 right closures, up to two aliased
groups of 4, and up to five random ones for a right one (where none is right, up to 30). Writes
summary.json: {group: {worlds, named, findings, seconds}}.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax import MultiRobotGraph, chi2_gate, weigh
from pcm_jax.integrity import triage
from pcm_jax.simulation import simulate_city, simulate_sessions

GROUPS = {"SE2": simulate_city, "SE3": simulate_sessions}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.silence", description=__doc__)
    parser.add_argument("--worlds", type=int, default=200, metavar="N", help="of each group")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    written = options.out / "summary.json"
    summary = json.loads(written.read_text()) if written.is_file() else {}
    for group in GROUPS:
        if summary.get(group, {}).get("worlds") != options.worlds:
            summary[group] = _named(group, options.worlds)
            written.write_text(json.dumps(summary, indent=2) + "\n")
    print(json.dumps(summary, indent=2))
    return 0


def cluttered_world(group: str, seed: int) -> MultiRobotGraph:
    """A world with few right closures or none, and many false ones."""
    generator = np.random.default_rng(seed)
    right = int(generator.integers(0, 11))
    random = int(generator.integers(2, max(3, 5 * right) if right else 30))
    aliased = int(generator.integers(0, 3))
    clutter = {"random": random, "aliased_groups": aliased, "aliased_size": 4}
    return GROUPS[group](seed=seed, poses=40, inliers=right, **clutter).graph


def _named(group: str, worlds: int) -> dict[str, Any]:
    """Worlds of which triage names a mistake, and its sentences."""
    start, findings = time.perf_counter(), {}
    for seed in range(worlds):
        graph = cluttered_world(group, seed)
        found = triage(weigh(graph), float(chi2_gate(0.99, graph.tangent_dim)))
        if found is not None:
            findings[str(seed)] = found.sentence
        if seed % 20 == 19:
            print(f"{group}: {seed + 1} worlds, {len(findings)} named", flush=True)
    seconds = time.perf_counter() - start
    return {"worlds": worlds, "named": len(findings), "findings": findings, "seconds": seconds}


if __name__ == "__main__":
    raise SystemExit(main())
