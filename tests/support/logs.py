"""Scan logs for tests of the file formats."""

import math
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import strategies as st

from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.log_file import load_scan_log
from jaxsonar.scans.scan_log import Log

HEADER = "scan,stamp,x,y,theta,tx,rx,range"

finite = st.floats(allow_nan=False, allow_infinity=False)
sensor = st.integers(0, 2**31 - 1)
echo = st.tuples(sensor, sensor, finite.filter(lambda r: r > 0), finite | st.just(math.nan))
pose = st.tuples(finite, finite, finite) | st.just((math.nan,) * 3)
one_scan = st.tuples(st.integers(-(2**63), 2**63 - 1), finite | st.just(math.nan), pose, st.lists(echo, max_size=4))


def log_of(scans):
    """A log from (scan, stamp, pose, [(tx, rx, range, amplitude, t, age), ...]) a scan; t and age may be omitted."""
    echoes = [(i, *e, *(0.0, 0.0)[len(e) - 4 :]) for i, (*_, heard) in enumerate(scans) for e in heard]
    index, tx, rx, reported, amplitude, t, age = zip(*echoes, strict=True) if echoes else ((),) * 7
    return Log.from_echoes(
        np.array(index, np.int64),
        np.array(tx, np.int64),
        np.array(rx, np.int64),
        np.array(reported, np.float64),
        amplitude=np.array(amplitude, np.float64),
        t=np.array(t, np.float64),
        age=np.array(age, np.float64),
        stamp=np.array([s[1] for s in scans], np.float64),
        pose=np.array([s[2] for s in scans], np.float64).reshape(-1, 3),
        scan=np.array([s[0] for s in scans], np.int64),
    )


seconds = st.just(0.0) | finite.filter(lambda value: value >= 0)
heard = st.lists(st.tuples(echo.map(lambda one: one[2]), finite | st.just(math.nan)), max_size=3)
path_readings = st.tuples(heard, seconds, seconds)


def _readings(paths):
    """Readings of a scan from {(tx, rx): (echoes, t, age)}; a path without echoes is silent."""
    return [
        (*pair, *one, t, age) for pair, (echoes, t, age) in paths.items() for one in echoes or [(math.nan, math.nan)]
    ]


paths = st.dictionaries(st.tuples(sensor, sensor), path_readings, max_size=3).map(_readings)
one_measured_scan = st.tuples(st.integers(-(2**63), 2**63 - 1), finite | st.just(math.nan), pose, paths)

# Logs are built in the tests: the shape checks of the test run use `random`, which no strategy may.
any_scans = st.lists(one_scan | one_measured_scan, max_size=5, unique_by=lambda s: s[0])

SMALL = log_of(
    [
        (7, 0.5, (1.25, -2.5, 0.75), [(0, 1, 1.5, 10.0), (2, 3, 0.1, math.nan)]),
        (3, math.nan, (math.nan,) * 3, []),
        (9, 2.0, (3.5, 4.5, -3.0), [(4, 5, 2.25, 20.0)]),
    ]
)
SMALL_CSV = f"""{HEADER},amplitude
7,0.5,1.25,-2.5,0.75,0,1,1.5,10.0
7,0.5,1.25,-2.5,0.75,2,3,0.1,
3,,,,,,,,
9,2.0,3.5,4.5,-3.0,4,5,2.25,20.0
"""


def echoes_of(log):
    """The log without paths that heard nothing."""
    heard = np.isfinite(log.range)
    return Log.from_echoes(
        log.echo_scan[heard],
        log.tx[heard],
        log.rx[heard],
        log.range[heard],
        amplitude=log.amplitude[heard],
        t=log.t[heard],
        age=log.age[heard],
        stamp=log.stamp,
        pose=log.pose,
        scan=log.scan,
    )


def read(text, name="log.csv"):
    """The log in a file with these bytes."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / name
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load_scan_log(file)


def refused(text, name="log.csv"):
    """The message about these bytes: one line that begins with the file."""
    with pytest.raises(SonarError) as caught:
        read(text, name)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.isprintable()
    assert re.search(rf"/{re.escape(name)}: ", message)
    return message
