"""SE(2), SE(3) and the real line: exp, log and Jacobians accurate at every angle.

Two layers share one set of formulas. The modules `se2`, `se3` and `r1` work entry by entry on
tuples of arrays and serve kernels (JAX) and host code (NumPy) alike. The functions exported here
work on batches of `jaxlie.SE2`, `jaxlie.SE3` and `R1`, which are the package's containers.

unrolled     small matrices as nested tuples of arrays
_angle       functions of the squared angle, from which exp, log and Jacobians are built
se2, se3     the groups, entry by entry
r1           the line, and its container `R1`
transforms   the same on batches, with whichever group: what is exported here

Conventions: perturbations are on the right, `T exp(δ)`; a tangent vector is (translation,
rotation), in metres and radians.
"""

from pcm_jax.lie.r1 import R1
from pcm_jax.lie.transforms import (
    Group,
    Transform,
    adjoint,
    as_device,
    as_matrix,
    as_numpy,
    between,
    components,
    compose,
    concatenate,
    exp,
    from_components,
    from_matrix,
    group_of,
    identity,
    inverse,
    log,
    module_of,
    normalize,
    own_precision,
    pad_leading,
    parameters,
    right_jacobian,
    right_jacobian_inverse,
    stack,
    take,
    tangent_dim,
    translation,
)

__all__ = [
    "R1",
    "Group",
    "Transform",
    "adjoint",
    "as_device",
    "as_matrix",
    "as_numpy",
    "between",
    "components",
    "compose",
    "concatenate",
    "exp",
    "from_components",
    "from_matrix",
    "group_of",
    "identity",
    "inverse",
    "log",
    "module_of",
    "normalize",
    "own_precision",
    "pad_leading",
    "parameters",
    "right_jacobian",
    "right_jacobian_inverse",
    "stack",
    "take",
    "tangent_dim",
    "translation",
]
