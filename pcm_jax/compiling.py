"""Whether a computation runs in NumPy or in a program that is compiled for it first.

Compiling takes seconds, whatever the size of the problem; the same law on NumPy arrays takes
milliseconds for a small problem, and compiles nothing. So a computation of one size runs in NumPy
until what that has cost in this process comes to what compiling would, and in the compiled program
from then on: never much more than twice the cost of the better choice, whatever comes after. Large
problems are compiled for at once.

Both give the same numbers but for rounding (1e-12 relative). Where every bit has to be the same
over one process, set the environment variable `PCM_JAX_COMPILE=always`: nothing then runs in
NumPy that can be compiled.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Hashable

ALWAYS = "PCM_JAX_COMPILE"
KEPT = 1024
"""Sizes that are remembered; the one unused for longest is forgotten first."""


class Thrift:
    """The account of what equal computations have cost in NumPy.

    Args:
        budget: what compiling costs, in the unit in which `compiles` is told of work.
    """

    def __init__(self, budget: float):
        self._budget = budget
        self._lock = threading.Lock()
        self._spent: OrderedDict[Hashable, float] = OrderedDict()

    def compiles(self, key: Hashable, work: float) -> bool:
        """True if work of this kind is better compiled; else it is entered as done in NumPy.

        Args:
            key: of all that shares one compiled program.
            work: in NumPy, this once.
        """
        if os.environ.get(ALWAYS) == "always":
            return True
        with self._lock:
            spent = self._spent.pop(key, 0.0) + work
            self._spent[key] = spent
            if len(self._spent) > KEPT:
                self._spent.popitem(last=False)
        return spent > self._budget
