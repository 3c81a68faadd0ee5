"""The choice between NumPy and a program that has to be compiled first.

Compiling takes seconds, whatever the size of the problem; the same law on NumPy arrays takes
milliseconds for a small problem, and compiles nothing. So a computation runs in NumPy where that
is expected to take less than compiling would, and is compiled otherwise. The two give the same
numbers but for rounding (1e-12 relative), so the choice is made by the input alone: neither by the
clock nor by what the process did before, and equal inputs give equal bits, in any thread.

NumPy takes 0.8 to 1.7 times as long as the compiled solver, and 3 to 8 times as long as the
compiled distances, which are a tenth of a merge. A process that merges thousands of times gains by
the environment variable `PCM_JAX_COMPILE=always`: nothing then runs in NumPy that can be compiled.
"""

from __future__ import annotations

import os

ALWAYS = "PCM_JAX_COMPILE"
SECONDS_TO_COMPILE = 3.0
"""About what a program of this package takes to compile."""


def is_worth_compiling(seconds: float) -> bool:
    """True where a computation is compiled for.

    Args:
        seconds: that it is expected to take in NumPy, from its size.
    """
    return seconds > SECONDS_TO_COMPILE or os.environ.get(ALWAYS) == "always"
