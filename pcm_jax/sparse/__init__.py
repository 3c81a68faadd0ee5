"""Block-sparse Cholesky factorisation on the host: NumPy and LAPACK. Knows no poses.

_symbolic       the elimination order and the tree of fronts, from the pattern alone
assembly        the plan of the numeric part: where each block is added
system          normal equations by their pattern: from the edges' products to `H` and its plan
cholesky        the factorisation and its solves
inverse         parts of the inverse: a block, its diagonal, some columns
selected        all blocks of the inverse where the factor has some

registry        the one owner of what is kept from call to call, and of BLAS's threads:
_pattern_cache  what depends on a pattern alone, made once and found by content
_memory         memory that one factorisation leaves to the next
_blas           the process-wide number of BLAS threads
"""
