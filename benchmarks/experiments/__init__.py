"""Modules that the paper's experiments share.

command   options that all have (--seeds, --jobs, --out), tasks in processes, the record of a run
record    rows and means of figures, CSV, progress, and the sources that results depend on
cities    the two maps of one city and the true closures between them: a file's, or simulated
one_dimensional   settings of the one-dimensional world, and selectors by batches
drifting          worlds whose maps drift and close loops more or less, with outliers that are hard
solver_timing     how long the methods take on one such world, and where they give up
"""
