"""The README's picture, and the script that makes it: `python -m benchmarks.pictures`."""
