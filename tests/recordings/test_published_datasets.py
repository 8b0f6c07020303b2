"""Published data sets as logs: every reading is kept, and files hold all of it."""

import numpy as np
import pytest
from support.recordings import recorded

from jaxsonar import load_log, load_ring, save_log
from jaxsonar.hardware.datasets import read_corridor8, read_scitos24
from jaxsonar.recordings.input_options import InputOptions
from jaxsonar.scans.flat_echoes import FlatEchoes
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.no_echo_values import find_no_echo_values
from jaxsonar.scans.readings import is_repeated, unique_readings
from jaxsonar.scans.sliding_windows import is_fresh_reading

READERS = {"corridor8": read_corridor8, "slip8": read_corridor8, "scitos24": read_scitos24}


def load(name):
    """A recording of this machine as a log."""
    return load_log(recorded(name), options=InputOptions(format="corridor8" if name == "slip8" else name))


def corridor(folder, readings, *, period=200):
    """Write a recording like corridor8: the first sensor has these ranges (mm), the others hear nothing."""
    rows = [f"{1000 + period * k} {value}{' 5110' * 7}\n" for k, value in enumerate(readings)]
    (folder / "measurement.txt").write_text("".join(rows))
    poses = [f"{1000 + period * k} {50 * k} 0 0\n" for k in range(len(readings))]
    (folder / "poses.txt").write_text("".join(poses))
    return load_log(folder, options=InputOptions(format="corridor8"))


def test_every_reading_is_kept_with_its_age(tmp_path):
    log = corridor(tmp_path, [500, 500, 500, 510, 5110, 5110])
    assert len(log.tx) == 6 * 8
    first = log.tx == 0
    np.testing.assert_array_equal(log.range[first], [0.5, 0.5, 0.5, 0.51, np.nan, np.nan])
    np.testing.assert_allclose(log.age[first], [0, 0.2, 0, 0, 0, 0.2], atol=1e-9)
    assert not len(log.asked)


def test_a_reading_that_was_not_renewed_is_no_measurement(tmp_path):
    log = corridor(tmp_path, [500, 500, 500, 510, 5110, 5110])
    ring = load_ring("corridor8")
    path = ring.path_index[0, 0]
    np.testing.assert_array_equal(measured_paths(ring, log)[:, path], [True, False, True, True, True, False])
    assert unique_readings(log).echo_count == 3
    flat, _ = FlatEchoes.from_log(ring, log)
    assert flat.scan.tolist() == [0, 2, 3]


@pytest.mark.parametrize("name", ["corridor8", "slip8"])
def test_renewed_readings_are_those_of_the_rule_for_logs_without_ages(name):
    log = load(name)
    heard = np.isfinite(log.range)
    without_ages = type(log).from_echoes(
        log.echo_scan[heard], log.tx[heard], log.rx[heard], log.range[heard], stamp=log.stamp, pose=log.pose
    )
    flat, _ = FlatEchoes.from_log(load_ring("corridor8"), without_ages)
    fresh = is_fresh_reading(flat)
    expected = {(scan, path) for scan, path in zip(flat.scan[fresh].tolist(), flat.path[fresh].tolist(), strict=True)}
    kept = heard & ~is_repeated(log)
    path = load_ring("corridor8").path_index[log.tx, log.rx]
    assert {(s, p) for s, p in zip(log.echo_scan[kept].tolist(), path[kept].tolist(), strict=True)} == expected


@pytest.mark.slow
@pytest.mark.parametrize("name", ["corridor8", "slip8", "scitos24"])
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_files_keep_every_reading_of_a_recording(name, suffix, tmp_path):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    log = load(name)
    save_log(log, tmp_path / f"log{suffix}")
    assert load_log(tmp_path / f"log{suffix}") == log
    recording = READERS[name](recorded(name))
    np.testing.assert_array_equal(log.echo_scan, recording.scan_index)
    for column in ("stamp", "pose", "tx", "rx", "range", "age"):
        np.testing.assert_array_equal(getattr(log, column), getattr(recording, column))
    ring = load_ring("scitos24" if name == "scitos24" else "corridor8")
    assert (ring.path_index[log.tx, log.rx] >= 0).all()  # the shipped ring has every path of the recording


@pytest.mark.parametrize("name", ["corridor8", "slip8", "scitos24"])
def test_no_range_of_a_recording_is_taken_for_a_mark(name):
    assert find_no_echo_values(load(name)) == ()


def test_a_sew_message_without_objects_is_a_scan_of_silent_paths(tmp_path):
    silent = ["65535,65535,65535,65535"] * 48
    one = [*silent[:36], "65535,65535,700,65535", "65535,65535,800,65535", *silent[:10]]  # tx 3, rx 2: 0.7 m
    (tmp_path / "dist.csv").write_text("\n".join(["rx0,rx1,rx2,rx3", *silent, *one, ""]))
    log = load_log(tmp_path, options=InputOptions(format="sew-amr"))
    assert [scan.echo_count for scan in log] == [0, 1]
    assert [len(scan.tx) for scan in log] == [16, 16]
    heard = np.isfinite(log.range)
    assert (log.tx[heard], log.rx[heard], log.range[heard]) == (3, 2, 0.7)
    assert measured_paths(load_ring("sew-amr"), log).all()
    save_log(log, tmp_path / "log.csv")
    assert load_log(tmp_path / "log.csv") == log
