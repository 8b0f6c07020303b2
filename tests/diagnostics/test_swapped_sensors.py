"""Exchanged sensors: the exchange is named, and the other results do not depend on it."""

import numpy as np
import pytest
from support.hard_cones import simulate
from support.health_logs import RING, renumbered

from jaxsonar.diagnostics.check_ring import check
from jaxsonar.simulation.office import load_office


@pytest.mark.slow
@pytest.mark.parametrize("pair", [(5, 6), (5, 7)])
def test_swapped_sensors_are_named(log, pair):
    place = np.arange(24)
    place[list(pair)] = pair[::-1]
    found = check(RING, renumbered(log, place))
    assert (found.place == place).all()
    assert found.findings[0].sentence.startswith(f"sensors {pair[0]} and {pair[1]} look swapped")
    assert found.remarks[pair[0]] == f"swapped with {pair[1]}"
    assert sum(map(bool, found.remarks)) == 2


@pytest.mark.slow
def test_a_swap_is_distinguished_from_its_mirror_image():
    """In the office the poses are similar: with the original walls, (4, 8) fits better than the true (5, 7)."""
    office = load_office()
    heard = simulate(office.ring, office.room, office.poses, sigma=0.001, stamps=office.stamps)
    place = np.arange(24)
    place[[5, 7]] = 7, 5
    found = check(office.ring, renumbered(heard.as_log(office.ring, office.poses), place))
    assert (found.place == place).all()
    assert len(found.findings) == 1


@pytest.mark.slow
def test_renumbered_sensors_give_the_renumbered_results(log, healthy):
    """If the exchange is found, the other results are the same as without it."""
    place = np.arange(24)
    place[[3, 15]] = 15, 3
    found = check(RING, renumbered(log, place))
    np.testing.assert_array_equal(found.heard, healthy.heard[place])
    np.testing.assert_array_equal(found.offset, healthy.offset[place])
    np.testing.assert_array_equal(found.direct, healthy.direct[place])


@pytest.mark.slow
def test_a_cyclic_exchange_of_three_sensors_is_named(log):
    place = np.arange(24)
    place[[2, 9, 16]] = 9, 16, 2
    found = check(RING, renumbered(log, place))
    assert found.findings[0].sentence.startswith("sensors 2, 16 and 9 look permuted")
