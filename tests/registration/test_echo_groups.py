"""Groups of echoes: every echo belongs to a group of its own scan or is unassigned."""

import numpy as np


def test_every_echo_is_grouped_or_unassigned(office, observations):
    _, _, log, _ = office
    grouped, unassigned = len(observations.grouped.scan), len(observations.unassigned.scan)
    assert grouped + unassigned == sum(len(log[row].range) for row in range(len(log)))
    assert grouped > 0.9 * (grouped + unassigned)
    np.testing.assert_array_equal(observations.groups.scan[observations.grouped.group], observations.grouped.scan)
