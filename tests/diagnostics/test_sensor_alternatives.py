"""What explains the echoes of a sensor: the fault that made them, and nothing for sound sensors."""

import numpy as np
import pytest

from jaxsonar.diagnostics.echo_residuals import ResidualTable
from jaxsonar.diagnostics.sensor_alternatives import (
    SensorAlternative,
    explained_otherwise,
    sensor_alternatives,
    suspects,
)

SENSORS, FAULTY, NOISE = 8, 3, 0.003
HALF = np.full(SENSORS, np.radians(15.0))


def echoes(rng, cause="", *, scans=200, detected=0.9, foreign=0.05, support=9):
    """Expected and reported echoes: one wall for each sensor and scan, in any direction up to 40 deg off its axis."""
    scan, sensor = (one.ravel() for one in np.mgrid[:scans, :SENSORS])
    of_it = sensor == FAULTY
    off_axis = np.radians(rng.uniform(-40, 40, len(scan)))
    turn = np.radians(25.0) * of_it * (cause == "turned")
    rate = np.where(of_it, {"weak": 0.25, "dead": 0.0, "astray": 0.0}.get(cause, detected), detected)
    heard = (np.abs(off_axis - turn) < HALF[0]) & (rng.random(len(scan)) < rate)
    residual = np.where(heard, NOISE * rng.standard_normal(len(scan)), np.inf)
    residual += 0.05 * of_it * (cause == "offset")
    elsewhere = ~heard & (rng.random(len(scan)) < np.where(of_it & (cause == "astray"), 0.8, foreign))
    residual[elsewhere] = rng.uniform(0.3, 1.5, elsewhere.sum())
    zero, yes = np.zeros(len(scan)), np.ones(len(scan), bool)
    return ResidualTable(
        wall=scan // 50,
        scan=scan,
        tx=sensor,
        rx=sensor,
        residual=residual,
        is_nearest=yes,
        d_range_d_wall=np.zeros((len(scan), 2)),
        visibility=zero + 1,
        off_axis=off_axis,
        beyond_end=zero,
        unobstructed=yes,
        along=zero,
        independent_echoes=np.full(len(scan), support),
        is_between=yes,
        echo_tx=sensor,
        echo_rx=sensor,
        echo_residual=np.abs(residual),
    )


@pytest.mark.parametrize(
    ("cause", "value"),
    [("turned", np.radians(25.0)), ("offset", 0.05), ("weak", 0.25), ("dead", 0.01), ("astray", 0.01)],
)
def test_the_fault_that_made_the_echoes_explains_them_best(rng, cause, value):
    foreign = 0.0 if cause == "dead" else 0.05
    table = echoes(rng, cause, foreign=foreign)
    found = sensor_alternatives(table, HALF, NOISE, 5.0)
    assert [k for k, one in enumerate(found) if one] == [FAULTY]
    one = found[FAULTY]
    assert one is not None
    assert one.cause == cause
    assert abs(one.value - value) < max(4 * one.error, 1e-9)
    assert one.nats > 12
    assert suspects(table, HALF, NOISE)[0] == FAULTY


def test_sound_sensors_need_no_other_explanation(rng):
    for detected in (0.7, 0.95):
        assert sensor_alternatives(echoes(rng, detected=detected), HALF, NOISE, 5.0) == [None] * SENSORS


def test_without_walls_that_other_sensors_support_nothing_is_judged(rng):
    table = echoes(rng, "dead", support=1)
    assert sensor_alternatives(table, HALF, NOISE, 5.0) == []
    assert suspects(table, HALF, NOISE) == []


def alternative(cause, value):
    return SensorAlternative(cause, value, 0.02, 50.0, 40, 10, 60, 55, 9)


def test_findings_name_cause_size_and_evidence():
    found = {
        one.finding.sensors[0]: one.finding
        for one in explained_otherwise(
            {
                0: None,
                1: alternative("turned", np.radians(-30.0)),
                2: alternative("weak", 0.25),
                3: alternative("astray", 0.0),
                4: alternative("offset", 0.05),
            }
        )
    }
    assert {k: one.cause for k, one in found.items()} == {1: "turned", 2: "weak", 3: "turned"}
    assert "points 30 ± 1 deg too far to the right" in found[1].sentence
    assert "10 of 40 expected direct echoes" in found[2].sentence
    assert "does not point where it should" in found[3].sentence
    for one in found.values():
        assert "explains 55 of 60 echoes, a sound sensor 9; log-likelihood ratio 50 nats" in one.evidence
        assert one.remedy
        assert one.confidence > 0.9
