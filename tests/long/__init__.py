"""Long runs: attacks that take minutes to hours, each with a log that is committed.

_log        what every log says of its run: commit, machine, seconds
_sites      the small changes that can be made to a module's text
mutants     those changes made one at a time: the tests of the folder must notice

Run them from the top of a checkout, `python -m tests.long.NAME --help`; pytest does not collect
them. Their logs lie in `logs/`; `tests/README.md` lists what was found. A short form of each, a
few seconds, is in `tests/test_long_runs.py`.
"""
