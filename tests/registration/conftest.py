"""Fixtures of the registration by ranges: scans of the office, and their grouped echoes."""

import pytest
from support.scans_without_odometry import SIGMA, simulated_log

from jaxsonar.registration.echo_groups import ScanObservations
from jaxsonar.simulation.office import load_office


@pytest.fixture(scope="session")
def office():
    """Ring, true poses, log and local models of five scans around the bend of the trajectory through the office."""
    place = load_office()
    poses = place.poses[11:16]
    return place.ring, poses, *simulated_log(place.ring, place.room, poses)


@pytest.fixture(scope="session")
def observations(office):
    """The echoes of the five scans, in groups."""
    ring, _, log, models = office
    return ScanObservations.of(ring, log, models, SIGMA)
