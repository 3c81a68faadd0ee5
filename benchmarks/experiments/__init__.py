"""What the paper's experiments share.

command   options that all have (--seeds, --jobs, --out), tasks in processes, the record of a run
record    steps kept on disk, so that a run goes on where it was killed; CSV, progress
cities    the two maps of one city and the true closures between them: a file's, or simulated
"""
