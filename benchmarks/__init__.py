"""Measurements of what the package promises and of what the paper reports.

`python -m benchmarks` runs the suite of promised figures (`benchmarks.suite`). Every experiment of
the paper, and three beyond it, is a command of its own:

one_dimensional_world   Figs 2 and 3: every method against enumeration
city                    Figs 4 and 5, Table I: City10000 with clutter
sessions                Figs 6 and 7, Table II: two sessions of one robot in space
place_recognition       real place recognition, and closures inside one robot's map
covariances             what the right covariance of the maps is worth

experiments             what these share: methods, runs kept on disk, options of the command line
results                 what they wrote: the numbers that documents cite
pictures                the README's picture
"""
