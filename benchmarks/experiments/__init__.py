"""What the paper's experiments share.

record    steps kept on disk, so that a run goes on where it was killed; JSON, CSV, progress
"""
