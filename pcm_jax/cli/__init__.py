"""The command line, `pcm-jax`: parse, call, print.

entry        runs a command; errors and warnings become lines on standard error
_interrupts  Ctrl-C, wherever it comes
_arguments   the options of all commands
_evaluate_arguments, _stream_arguments     those of two of them
_values      the options' texts as values
_cache       compiled programs kept on disk between commands
_inputs      the graph that the options describe
_progress    progress on standard error, for work that takes more than two seconds
calibrate, demo, evaluate, explain    one module a command, each with its `run`
formats, inspect, merge, simulate, stream     likewise
_drives      drives whose closures keep coming: a team's, or one robot's
_summary     the text that a merge prints
_advice      the one thing to do next, where something about a merge is odd
_reports     reports of merges, read again
_hints       options that mend a fit that cannot be meant, followed before they are named
_outputs     where results may be written, checked before anything is computed
_merged_files     a merge's maps group by group, or robot by robot; rejected closures

Nothing heavy is imported before a command needs it, so that `--help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

__all__ = ["console", "main"]

INTERRUPTED = 130  # 128 + SIGINT, as shells report it


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit status.

    Args:
        arguments: without the program's name; by default those of the process.

    Returns:
        0; 2 for bad input, with one line on standard error; 130 if interrupted, likewise.
    """
    try:
        from pcm_jax.cli.entry import run

        return run(arguments)
    except KeyboardInterrupt as interrupt:  # a search for a clique says what it had found
        if sys.stderr is not None:
            print(f"interrupted: {interrupt}" if interrupt.args else "interrupted", file=sys.stderr)
        return INTERRUPTED


def console() -> None:
    """Runs the command line as a process of its own, which ends with its exit status."""
    status = main()
    if status == INTERRUPTED:  # threads of the compiler may not survive being torn down
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        os._exit(status)
    raise SystemExit(status)
