"""Saved logs: a warning where a file cannot hold what a log measured."""

import numpy as np
import pytest

from jaxsonar import Log, Ring, load_log, save_log
from jaxsonar.scans.log_file import unmarked_paths
from jaxsonar.scans.measured_paths import measured_paths

RING = Ring.circular(count=3, neighbors=0)


def echoes_only(measured, **more):
    """A log with an echo of each measured path (scans, sensors)."""
    scan, sensor = np.nonzero(measured)
    scans = len(measured)
    pose = np.zeros((scans, 3))
    return Log.from_echoes(scan, sensor, sensor, 1 + 0.1 * sensor, stamp=np.arange(float(scans)), pose=pose, **more)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_the_warning_counts_the_paths_that_a_file_makes_silent(tmp_path, suffix):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    rng = np.random.default_rng(3)
    for chance in (0.4, 0.9, 1.0):
        measured = rng.random((30, 3)) < chance
        log, notes = echoes_only(measured, asked=np.zeros((0, 2), np.int64)), []
        save_log(log, tmp_path / f"log.{suffix}", on_note=notes.append)
        loaded = load_log(tmp_path / f"log.{suffix}")
        changed = int((measured_paths(RING, loaded) & ~measured_paths(RING, log)).sum())
        assert unmarked_paths(log) == changed
        assert bool(changed) == (chance < 1)
        assert [text.split(" ")[:2] for text in notes] == [["warning:", str(changed)]] * (changed > 0)


def test_logs_that_a_file_holds_give_no_warning(tmp_path):
    measured = np.array([[True, True, False], [True, False, True]])
    implicit, notes = echoes_only(measured), []
    in_turn = echoes_only(np.tile(np.eye(3, dtype=bool), (5, 1)))
    k, ranges = np.arange(2), np.array([1, np.nan])
    silent = Log.from_echoes(k, k, k, ranges, stamp=np.zeros(2), pose=np.zeros((2, 3)))
    for log in (implicit, in_turn, silent, Log.from_scans([])):
        save_log(log, tmp_path / "log.csv", on_note=notes.append)
        assert measured_paths(RING, load_log(tmp_path / "log.csv")).tolist() == measured_paths(RING, log).tolist()
    assert notes == []
