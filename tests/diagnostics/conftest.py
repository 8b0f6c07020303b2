"""Fixtures of the health check: a log of a healthy ring, and its result."""

import pytest
from support.health_logs import RING, log_of

from jaxsonar.diagnostics.check_ring import check


@pytest.fixture(scope="session")
def log():
    """A log of the healthy ring."""
    return log_of(7)


@pytest.fixture(scope="session")
def healthy(log):
    """The health check of the healthy ring."""
    return check(RING, log)
