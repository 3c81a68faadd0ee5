"""`main`: runs one command, and turns what the library raises and warns into lines of text."""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pcm_jax.cli._arguments import parser
from pcm_jax.cli._cache import keep_compiled
from pcm_jax.errors import InputError, InputWarning

BAD_INPUT = 2
INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit status.

    Args:
        arguments: without the program's name; by default those of the process.

    Returns:
        0; 2 for bad input, with one line on standard error; 130 if interrupted.
    """
    options = parser().parse_args(arguments)
    keep_compiled()
    command = importlib.import_module(f"pcm_jax.cli.{options.command}")
    try:
        with _warnings_as_lines():
            command.run(options)
    except InputError as error:
        return _failed(str(error))
    except BrokenPipeError:  # the reader of our output (head, less) has seen enough
        sys.stdout = None
        return 0
    except OSError as error:
        return _failed(f"{error.filename}: {error.strerror}" if error.filename else str(error))
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


def _failed(problem: str) -> int:
    print(f"error: {problem}", file=sys.stderr)
    return BAD_INPUT


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
