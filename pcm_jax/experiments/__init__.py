"""Experiments over methods, graphs and simulated worlds, which notebooks and benchmarks share.

    cities         City10000 in two halves, or a simulated one, and versions with false closures
    drives         drives with a real front end's candidates, or simulated ones; two robots of one
    comparison     every method on the same maps, closures and evidence, beside the truth
    sweep          every method at every gate on thousands of simulated worlds
    _sweep_files   its Parquet files, by which it resumes

Which methods, worlds and gates the paper has is for the benchmarks to say.
"""

from pcm_jax.experiments.comparison import (
    BEYOND_THE_PAPER,
    CALIBRATED,
    PAPER,
    Compared,
    Method,
    called,
    compare_methods,
    mean_figures,
)
from pcm_jax.experiments.sweep import sweep

__all__ = [
    "BEYOND_THE_PAPER",
    "CALIBRATED",
    "PAPER",
    "Compared",
    "Method",
    "called",
    "compare_methods",
    "mean_figures",
    "sweep",
]
