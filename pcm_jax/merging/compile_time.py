"""The time that JAX compiled during a call, by JAX's own monitoring events."""

from __future__ import annotations

import functools
from typing import Any

import jax

_COMPILING = ("jaxpr_to_mlir_module_duration", "backend_compile_duration")
_spent = [0.0]


@functools.cache
def _listen() -> None:
    def add(event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith(_COMPILING):
            _spent[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(add)


class CompileClock:
    """A scope; `seconds` is what lowering and compiling took within it."""

    def __enter__(self) -> CompileClock:
        _listen()
        self._before, self.seconds = _spent[0], 0.0
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = _spent[0] - self._before
