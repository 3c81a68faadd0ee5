"""The command line, `pcm-jax`: parse, call, print.

entry        `main`: runs a command; errors and warnings become lines on standard error
_arguments   the options of all commands
_cache       compiled programs kept on disk between commands
_inputs      the graph that the options describe
_progress    progress on standard error, for work that takes more than two seconds
demo, evaluate, explain, formats, inspect, merge, simulate  a module per command: `run(arguments)`
_summary     the text that a merge prints
_advice      the one thing to do next, where something about a merge is odd
_reports     reports of merges, read again
_hints       options that mend a fit that cannot be meant, followed before they are named
_outputs     where results may be written, checked before anything is computed
_merged_files     a merge's maps group by group, or robot by robot; rejected closures

Nothing heavy is imported before a command needs it, so that `--help` answers at once.
"""

from pcm_jax.cli.entry import main

__all__ = ["main"]
