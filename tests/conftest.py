"""Strict everywhere: no silent broadcast over ranks, no silent change of type; warnings are errors (pyproject)."""

import jax
import numpy as np
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def rng():
    return np.random.default_rng(20240917)


@pytest.fixture(scope="session")
def faw_ring():
    """The paper's ring: 24 sensors, 60 deg cones, neighbors up to the third."""
    from jaxsonar import Ring

    return Ring.circular()


settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")
