"""The selection methods: one file each, with the host's form and the kernel side by side.

pcm             the paper's: a maximum clique, exactly or greedily
combinatorial   the same set by enumeration
ransac          every measurement tried as the model
scgp            the densest cluster, by the leading eigenvector
clipper         a dense clique, by a relaxation
jcbb            the largest set that passes as a whole, by branch and bound

A file is found by being here: its tuple `METHODS` of `SelectionMethod` records says what it offers
by which names. A method of one's own needs no file: `select` and `merge` take a function.
"""

from __future__ import annotations

import importlib
import pkgutil

from pcm_jax.selection.method import SelectionMethod

_MODULES = sorted(
    (module.name for module in pkgutil.iter_modules(__path__)),
    key=lambda name: (name != "pcm", name),  # the paper's own first
)
METHODS: dict[str, SelectionMethod] = {
    method.name: method
    for module in _MODULES
    for method in importlib.import_module(f"{__name__}.{module}").METHODS
}
"""All methods by name."""

__all__ = ["METHODS"]
