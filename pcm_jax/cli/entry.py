"""`run`: runs one command, and turns what the library raises and warns into lines of text."""

from __future__ import annotations

import importlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from pcm_jax.cli._arguments import parser
from pcm_jax.cli._cache import keep_compiled
from pcm_jax.cli._interrupts import Interrupts
from pcm_jax.errors import InputError, InputWarning

BAD_INPUT = 2


def run(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; see `pcm_jax.cli.main`.

    Raises:
        KeyboardInterrupt: if one came.
    """
    with _any_text(), Interrupts():
        return _run(arguments)


def _run(arguments: Sequence[str] | None) -> int:
    options = parser().parse_args(arguments)
    keep_compiled()
    try:
        command = importlib.import_module(f"pcm_jax.cli.{options.command}")
        with _warnings_as_lines():
            command.run(options)
    except InputError as error:
        return _told(f"error: {error}", BAD_INPUT)
    except BrokenPipeError:  # the reader of our output (head, less) has seen enough
        sys.stdout = None
        return 0
    except OSError as error:
        problem = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        return _told(f"error: {problem}", BAD_INPUT)
    return 0


def _told(line: str, status: int) -> int:
    print(line.replace("\n", "\\n"), file=sys.stderr)
    return status


@contextmanager
def _any_text() -> Iterator[None]:
    """A scope in which standard output and error take whatever is printed.

    What their encoding lacks is written as an escape; where they are closed, nothing is.
    """
    found = sys.stdout, sys.stderr
    with ExitStack() as nowhere:
        for name in ("stdout", "stderr"):
            stream: Any = getattr(sys, name)
            if stream is None:
                stream = nowhere.enter_context(Path(os.devnull).open("w"))
                setattr(sys, name, stream)
            elif hasattr(stream, "reconfigure"):
                stream.reconfigure(errors="backslashreplace")
        try:
            yield
        finally:
            for name, stream in zip(("stdout", "stderr"), found, strict=True):
                if stream is None:
                    setattr(sys, name, None)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """An `InputWarning` within becomes one line on standard error, after all went well.

    Bad input thus leaves the one line that says what is wrong. Other warnings are left as they are.
    """
    lines: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("always", InputWarning)
        show = warnings.showwarning

        def keep(message: Any, category: Any, *place: Any, **options: Any) -> None:
            if issubclass(category, InputWarning):
                lines.append(f"warning: {message}")
            else:
                show(message, category, *place, **options)

        warnings.showwarning = keep
        yield
    for line in lines:
        print(line, file=sys.stderr)
