"""Block-sparse Cholesky factorisation on the host: NumPy and LAPACK. Knows no poses.

_symbolic       the elimination order and the tree of fronts, from the pattern alone
assembly        the plan of the numeric part: where each block is added
cholesky        the factorisation and its solves
inverse         parts of the inverse: a block, its diagonal, some columns
pattern_cache   what depends on a pattern alone, made once and found by content
"""
