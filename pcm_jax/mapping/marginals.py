"""The former place of `covariance`; goes with its last caller, `consistency.streaming`."""

from pcm_jax.mapping.covariance import covariance_factor, joint_marginal_covariance

__all__ = ["covariance_factor", "joint_marginal_covariance"]
