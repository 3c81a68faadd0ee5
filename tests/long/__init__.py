"""Long runs: attacks that take minutes to hours, each with a log that is committed.

_log        what every log says of its run: commit, machine, seconds
_seeds      small valid files of every format, to be changed
_rtabmap_tables the tables of a database, to be filled
_g2o_oracle a strict reader of g2o of its own
_executed   which lines each test file executes, noted by a plugin of pytest
_sites      the small changes that can be made to a module's text
mutants     those changes made one at a time: the tests of the folder must notice
fuzz        every reader on files changed in a few places
guided      the same readers and verdict, guided by coverage
faults      the command line killed, without space, without rights
load        thousands of merges in one process
determinism the command line's files byte by byte, in processes set up differently
sequences   closures and poses that come and go, against the batch
limits      time limits of cliques on graphs up to 20,000 vertices
differential  random cases against GTSAM, networkx and SciPy

Run them from the top of a checkout, `python -m tests.long.NAME --help`; pytest does not collect
them. Their logs lie in `logs/`; `tests/README.md` lists what was found. A short form of each, a
few seconds, is in `tests/test_long_runs.py`.
"""
