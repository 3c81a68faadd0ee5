"""A small sweep, its rows, and the law of its worlds."""

import pyarrow.parquet

from pcm_jax.experiments import sweep

LAW = {"poses": 30, "inliers": 4, "aliased_groups": 1, "aliased_size": 3, "random": 5}
METHODS = ("pcm-exact", "pcm-heuristic", "ransac", "scgp")
GRID = {"methods": METHODS, "confidences": (0.5, 0.99), "seed": 7}
WORLDS = 200


def small_sweep(folder, **changes):
    return sweep(folder, **{"worlds": WORLDS, "batch": 64, **GRID, **LAW, **changes})


def rows_of(folder):
    return pyarrow.parquet.read_table(folder)
