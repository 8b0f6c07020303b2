"""``convert``: what a scan log cannot hold of its source is a warning."""

import numpy as np
import pytest
from support.commands import call

from jaxsonar import Ring, load_log, save_ring
from jaxsonar.hardware.messages import ECHO, Group
from jaxsonar.hardware.recorder import open_recorder
from jaxsonar.scans.measured_paths import measured_paths

RING = Ring.circular(count=4, neighbors=0)


def record(filename):
    """Ten scans of two groups (sensors 0, 2 and 1, 3); the second group is lost in every other scan."""
    recorder = open_recorder(filename)
    for scan in range(10):
        for group in range(2 - scan % 2):
            echoes = np.zeros(1, ECHO)
            echoes["tx"] = echoes["rx"] = group + 2 * (scan // 2 % 2)
            echoes["time_us"], echoes["amplitude"] = 6000 + scan, np.nan
            recorder.message(
                Group(2 * scan + group, 100_000 * scan, scan, group, 2, np.nan, echoes), 100.0 + 0.1 * scan
            )
    recorder.close()


def test_a_raw_recording_without_its_ring_is_a_warning(tmp_path, capsys):
    pytest.importorskip("mcap")
    ring, raw, log = tmp_path / "ring.toml", tmp_path / "raw.mcap", tmp_path / "log.csv"
    save_ring(RING, ring)
    record(raw)
    assert call("convert", raw, log, "--ring", ring) == 0
    assert "warning" not in capsys.readouterr().err
    expected = measured_paths(RING, load_log(raw, ring=RING))
    assert not expected.all()
    assert np.array_equal(measured_paths(RING, load_log(log)), expected)
    assert call("convert", raw, log) == 0
    assert "count as silent, whether or not they were measured; --ring is missing" in capsys.readouterr().err
    log.unlink()
    assert call("convert", raw, log, "--strict") == 2
    assert not log.exists()


def test_stamps_in_milliseconds_are_a_warning_and_strictly_an_error(tmp_path, capsys):
    rows = "".join(f"{k},{100 * k},{0.02 * k},0,0,0,0,1.5\n" for k in range(20))
    (tmp_path / "log.csv").write_text("scan,stamp,x,y,theta,tx,rx,range\n" + rows)
    assert call("convert", tmp_path / "log.csv", tmp_path / "out.csv") == 0
    assert "the stamps are probably milliseconds" in capsys.readouterr().err
    assert call("convert", tmp_path / "log.csv", tmp_path / "strict.csv", "--strict") == 2
    assert not (tmp_path / "strict.csv").exists()
