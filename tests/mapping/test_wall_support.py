"""Evidence of single measurements for a wall: signs, normalisation, predicted ranges and derivatives."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.hard_cones import simulate

from jaxsonar import Log, Ring, Room
from jaxsonar.geometry.se2 import unit
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_support import EchoModel, MeasurementIndex, line_evidence
from jaxsonar.reflectors.range_measurements import RangeMeasurements, independent_weights

SONARS = Ring.circular(count=8, radius=0.2, beam=math.radians(30.0), neighbors=0, max_range=3.0)
CENTER, NORMAL, SIGMA = np.array([0.3, 1.5]), math.pi / 2, 0.02
"""A wall along x at y = 1.5 m, in front of a robot below it."""


def measured(distance, *, origin=(0.0, 0.0), axis=math.pi / 2, is_first=True):
    """Direct measurements of one sensor, one for each distance."""
    distance = np.atleast_1d(np.asarray(distance, dtype=np.float64))
    rows = len(distance)
    return RangeMeasurements(
        origin=np.tile(np.asarray(origin, dtype=np.float64), (rows, 1)),
        half_baseline=np.zeros((rows, 2)),
        axis=np.full(rows, float(axis)),
        half_width=np.full(rows, math.radians(15.0)),
        distance=distance,
        is_first=np.full(rows, is_first),
        scan=np.arange(rows),
        time=np.arange(rows, dtype=np.float64),
        section=np.arange(rows),
        measurement=np.arange(rows),
        max_range=3.0,
    )


def log_ratio(*args, **kwargs):
    return line_evidence(measured(*args, **kwargs), CENTER, NORMAL, EchoModel(SIGMA)).log_ratio


def test_an_echo_of_the_wall_is_evidence_for_it_and_an_echo_from_behind_against_it():
    fitting, behind, silent = log_ratio([1.5, 1.9, np.inf])
    assert fitting > 2
    assert behind < -1.5
    assert silent < -1.5


def test_an_echo_from_in_front_of_the_wall_is_hardly_evidence():
    assert np.abs(log_ratio([0.3, 0.8, 1.3])).max() < 0.7


@pytest.mark.parametrize("degrees", [0, 5, 12, 20])
def test_evidence_becomes_weaker_with_the_angle(degrees):
    near, far = (log_ratio([1.5, 1.9], axis=math.pi / 2 + math.radians(turn)) for turn in (degrees, degrees + 4))
    assert 0 < far[0] < near[0]
    assert near[1] < far[1] < 0


def test_a_wall_out_of_view_has_no_evidence():
    assert not log_ratio([1.5, np.inf], axis=-math.pi / 2).any()  # the sensor faces the other way
    assert not log_ratio([1.5, np.inf], axis=0.0).any()
    assert not log_ratio([1.5, 0.5], origin=(0.0, 2.0)).any()  # it is on the other side of the wall
    assert not log_ratio([2.5, np.inf], origin=(0.0, -1.45)).any()  # the wall is at the border of the range


def test_only_the_first_echo_of_a_measurement_shows_that_nothing_is_in_front():
    assert log_ratio(1.9, is_first=False) == 0
    assert log_ratio(1.5, is_first=False) == log_ratio(1.5)


@pytest.mark.parametrize("sigma", [0.003, 0.02, 0.05])
def test_no_echo_has_more_evidence_than_one_that_fits_exactly(rng, sigma):
    most = EchoModel(sigma).largest_log_ratio(3.0)
    for degrees in (-10, 0, 5):
        many = measured(rng.uniform(0.1, 2.9, 500), axis=math.pi / 2 + math.radians(degrees))
        assert line_evidence(many, CENTER, NORMAL, EchoModel(sigma)).log_ratio.max() <= most + 0.05
    assert line_evidence(measured(1.5), CENTER, NORMAL, EchoModel(sigma)).log_ratio == pytest.approx(most)


@pytest.mark.parametrize("degrees", [0, 10, 20])
def test_the_model_with_a_wall_is_a_probability_distribution(degrees):
    """The likelihood ratio has the mean 1 over all outcomes without a wall."""
    step = 1e-4
    distance = np.arange(step / 2, 3.0, step)
    ratio = np.exp(log_ratio(np.append(distance, np.inf), axis=math.pi / 2 + math.radians(degrees)))
    heard = SETTINGS.support.heard
    assert heard * ratio[:-1].mean() + (1 - heard) * ratio[-1] == pytest.approx(1, abs=1e-3)


def test_predicted_ranges_are_those_of_the_simulator():
    ring = Ring.circular(count=24, radius=0.3, neighbors=3, max_range=3.0)
    wall = Room(np.array([[[-9.0, 1.4], [9.0, 1.4]]]))
    pose = np.array([[0.2, 0.1, 0.3]])
    log = simulate(ring, wall, pose, beams="hard").as_log(ring, pose)
    came = RangeMeasurements.from_log(ring, log)
    heard = came.take(np.isfinite(came.distance))
    assert len(heard) > 10
    assert np.any(heard.half_baseline)
    predicted, _ = heard.predicted(np.array([3.0, 1.4]), math.pi / 2)
    np.testing.assert_allclose(predicted, heard.distance, atol=1e-5)
    evidence = line_evidence(heard, np.array([3.0, 1.4]), math.pi / 2, EchoModel(SIGMA))
    assert evidence.fits.all()
    # Every path that does not hear the wall is silent: what was measured is complete.
    assert len(came) == len(ring.paths)


def test_derivatives_of_predicted_ranges(rng):
    one = replace(measured(np.ones(5)), origin=rng.normal(0, 0.3, (5, 2)), half_baseline=rng.normal(0, 0.1, (5, 2)))
    step = 1e-6
    _, came = one.predicted(CENTER, 1.3)
    along = [one.predicted(CENTER + sign * step * unit(1.3), 1.3)[0] for sign in (-1, 1)]
    turned = [one.predicted(CENTER, 1.3 + sign * step)[0] for sign in (-1, 1)]
    wanted = np.stack([(high - low) / (2 * step) for low, high in (along, turned)], axis=-1)
    np.testing.assert_allclose(came, wanted, atol=1e-6)


def test_measurements_of_a_log_are_those_of_scans_with_poses_at_new_places():
    pose = np.array([[0.0, 0, 0], [0, 0, 0], [0.5, 0, 0], [np.nan] * 3])
    zeros, heard = np.zeros(4, dtype=np.int64), np.array([1.0, 1.1, 1.2, 1.3])
    stamp = np.arange(4.0)
    log = Log.from_echoes(np.arange(4), zeros, zeros, heard, stamp=stamp, pose=pose, asked=SONARS.paths)
    came = RangeMeasurements.from_log(SONARS, log)
    heard = came.take(np.isfinite(came.distance))
    assert heard.scan.tolist() == [0, 2]
    np.testing.assert_allclose(heard.distance, [1.0, 1.2])
    assert len(came) == 16


def test_measurements_of_one_section_have_the_weight_of_one():
    weights = independent_weights(np.array([4, 4, 7, 4, 9]))
    np.testing.assert_allclose(weights, [1 / 3, 1 / 3, 1, 1 / 3, 1])
    pose = np.column_stack([np.arange(0, 1, 0.01), np.zeros(100), np.zeros(100)])
    zeros, stamp = np.zeros(100, dtype=np.int64), np.arange(100.0)
    log = Log.from_echoes(np.arange(100), zeros, zeros, np.ones(100), stamp=stamp, pose=pose, asked=SONARS.paths[:1])
    weights = independent_weights(RangeMeasurements.from_log(SONARS, log).section)
    assert weights.sum() == pytest.approx(10, abs=1)


def test_the_index_finds_every_measurement_that_can_meet_the_line(rng):
    many = replace(measured(np.ones(500)), origin=rng.uniform(-9, 9, (500, 2)))
    segment = np.array([[-1.0, 1.5], [1.0, 1.5]])
    found = MeasurementIndex(many).near(segment, 0.5)
    foot, ahead = many.origin[:, 0], 1.5 - many.origin[:, 1]
    assert set(np.flatnonzero((np.abs(foot) < 1.5) & (np.abs(ahead) < 3.0))) <= set(found)
    assert not len(MeasurementIndex(many.take(np.arange(0))).near(segment, 0.5))
