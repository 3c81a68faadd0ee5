"""`host_scope`: the settings that host code runs under, whatever is in force around it."""

from __future__ import annotations

import jax
import pytest

from pcm_jax.arrays import host_device, host_scope

OTHERS = {
    "32 bits": lambda: jax.enable_x64(False),
    "strict promotion": lambda: jax.numpy_dtype_promotion("strict"),
    "no rank promotion": lambda: jax.numpy_rank_promotion("raise"),
    "NaN checks": lambda: jax.debug_nans(True),
    "checks for infinities": lambda: jax.debug_infs(True),
    "no device": lambda: jax.default_device(None),
}


def settings():
    now = jax.config
    rules = now.jax_numpy_dtype_promotion, now.jax_numpy_rank_promotion
    return (
        now.jax_enable_x64,
        now.jax_default_device,
        *rules,
        now.jax_debug_nans,
        now.jax_debug_infs,
    )


EXPECTED = True, host_device(), "standard", "allow", False, False


@pytest.mark.parametrize("name", OTHERS)
def test_a_scope_inside_one_undoes_what_was_set_between(name):
    with host_scope():
        assert settings() == EXPECTED
        with OTHERS[name]():
            between = settings()
            assert between != EXPECTED
            with host_scope():
                assert settings() == EXPECTED
            assert settings() == between
        assert settings() == EXPECTED


def test_a_scope_inside_one_changes_nothing():
    with host_scope():
        with host_scope():
            assert settings() == EXPECTED
        assert settings() == EXPECTED
