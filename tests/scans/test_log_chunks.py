"""Chunks of a log: every split gives what the whole log measured, and the poses of its readings."""

import tempfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.logs import HEADER

from jaxsonar.geometry.se2 import subtract_poses
from jaxsonar.hardware.errors import SonarError
from jaxsonar.scans.firing_poses import reading_poses
from jaxsonar.scans.log_chunks import csv_chunk_reader, csv_chunks, parquet_chunk_reader, parquet_chunks
from jaxsonar.scans.log_file import load_scan_log, save_log
from jaxsonar.scans.log_parts import concatenate, readable_runs
from jaxsonar.scans.measured_paths import measured_paths
from jaxsonar.scans.readings import unique_readings
from jaxsonar.scans.scan_log import Log
from jaxsonar.sensors.ring import Ring

RING = Ring.circular(count=5, neighbors=1)
KINDS = ("implicit", "explicit", "explicit_late", "in_turn", "times", "ages")
SUFFIXES = ("csv", "parquet")


def some_log(kind, scans=40, seed=0):
    """A log of a robot that drives on a curve."""
    rng = np.random.default_rng(seed)
    rows = []
    for scan in range(scans):
        for tx, rx in RING.paths.tolist():
            if kind == "in_turn" and tx != scan % RING.count:
                continue
            if rng.random() < 0.6 and (kind != "implicit" or tx != 4 or scan > scans // 2):
                silent = kind in ("explicit", "times") or (kind == "explicit_late" and scan == scans - 1)
                rows.append((scan, tx, rx, np.nan if silent and rng.random() < 0.3 else rng.uniform(0.3, 1.9)))
    index, tx, rx, distance = np.array(rows).T
    index, tx, rx = (column.astype(int) for column in (index, tx, rx))
    stamp = 3.0 + 0.1 * np.arange(scans)
    pose = np.stack([0.5 * stamp, 0.1 * stamp, 0.3 * stamp], axis=-1)
    extra = {"t": 0.02 * tx} if kind == "times" else {}
    if kind == "ages":  # every third reading of a path is new, the others repeat it
        new = index - index % 3
        distance = 0.5 + 0.01 * (new + 100 * tx + 37 * rx) % 1.3
        extra = {"age": 0.1 * (index - new)}
    return Log.from_echoes(index, tx, rx, distance, stamp=stamp, pose=pose, **extra)


def chunks(path, scans):
    """The log of each chunk of a file."""
    plan, reader = (csv_chunks, csv_chunk_reader) if path.endswith("csv") else (parquet_chunks, parquet_chunk_reader)
    parts = plan(path, name="log", scans=scans)
    return parts, [reader(path, part, name="log")(0, part.scans) for part in parts]


def good_scans(path, scans):
    """The readable scans of a file with different numbers, from chunks of this size, without repeated readings."""
    plan, reader = (csv_chunks, csv_chunk_reader) if path.endswith("csv") else (parquet_chunks, parquet_chunk_reader)
    good = []
    for part in plan(path, name="log", scans=scans):
        runs, _ = readable_runs(reader(path, part, name="log"), part.scans)
        good += [run[k : k + 1] for first, run in runs for k in range(len(run)) if first + k not in part.repeated]
    return unique_readings(concatenate(good))


def assert_same_evidence(found, log):
    """The same echoes of the same measured paths, at the same poses."""
    assert np.array_equal(measured_paths(RING, found), measured_paths(RING, log))
    a, b = unique_readings(found), unique_readings(log)
    heard, expected = np.isfinite(a.range), np.isfinite(b.range)
    for column in ("echo_scan", "tx", "rx", "range"):
        assert np.array_equal(getattr(a, column)[heard], getattr(b, column)[expected])
    np.testing.assert_allclose(subtract_poses(reading_poses(a)[heard], reading_poses(b)[expected]), 0, atol=1e-9)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("kind", KINDS)
@given(scans=st.integers(1, 45))
def test_a_chunk_measured_what_the_whole_log_says(suffix, kind, scans):
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/log.{suffix}"
        save_log(some_log(kind), path)
        log = unique_readings(load_scan_log(path))
        parts, logs = chunks(path, scans)
        assert [part.first for part in parts] == list(range(0, 40, scans))
        assert {part.in_turn for part in parts} == {kind == "in_turn"}
        for part, found in zip(parts, logs, strict=True):
            assert_same_evidence(found, log[part.first : part.first + part.scans])


def test_the_file_decides_whether_a_chunk_is_explicit(tmp_path):
    """A single silent row at the end makes all chunks explicit."""
    path = tmp_path / "log.csv"
    rows = [f"{scan},,,,,{tx},{tx},1.5" for scan in range(6) for tx in range(3) if scan % 2 or tx != 1]
    path.write_text("\n".join([HEADER, *rows, ""]))
    assert {part.asked for part in csv_chunks(path, name="log", scans=2)} == {((0, 0), (1, 1), (2, 2))}
    path.write_text("\n".join([HEADER, *rows, "6,,,,,0,0,", ""]))
    assert {part.asked for part in csv_chunks(path, name="log", scans=2)} == {()}


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("block", [64, 1 << 20])
def test_invalid_rows_do_not_hide_the_measured_pairs(block, line_end, tmp_path, monkeypatch):
    """Planning skips them; they are reported when they are read."""
    monkeypatch.setattr("jaxsonar.scans.log_chunks.BLOCK", block)
    path = tmp_path / "log.csv"
    bad = ["2,,,,,x,1,1.5", "3,,,,,1", "4,,,,,-1,99999999999,1", "5,,,,,1,9999999999,1"]
    rows = ["0,,,,,0,0,1.5", "1,,,,,0,2,1.5", "1,,,,,1,2,1.5", *bad, "6,,,,,,,", "7,,,,,2,2,1.5"]
    path.write_bytes(line_end.join([HEADER, *rows, ""]).encode())
    parts = csv_chunks(path, name="log", scans=2)
    assert parts[0].asked == ((0, 0), (0, 2), (1, 2), (2, 2))
    assert csv_chunk_reader(path, parts[0], name="log")(0, 2).asked.tolist() == [[0, 0], [0, 2], [1, 2], [2, 2]]
    with pytest.raises(SonarError, match=r"row 5, column tx: 'x'"):
        csv_chunk_reader(path, parts[1], name="log")(0, 1)


def test_unreadable_surroundings_do_not_make_a_chunk_unreadable(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"{scan},{0.1 * scan:.1f},0,0,0,{tx},{tx},1.5,0.0{tx}" for scan in range(9) for tx in range(3)]
    rows[-1] = "8,0.8,0,0,0,2,2,wall,"
    path.write_text("\n".join([HEADER + ",t", *rows, ""]))
    first, *_, last = csv_chunks(path, name="log", scans=3)
    assert len(csv_chunk_reader(path, first, name="log")(0, 3).tx) == 9
    with pytest.raises(SonarError, match="row 28, column range: 'wall'"):
        csv_chunk_reader(path, last, name="log")(0, 3)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("bad", [9, 13, 14])
def test_one_bad_scan_does_not_change_the_evidence_of_the_others(tmp_path, monkeypatch, suffix, bad):
    """A bad range, or a number that came before, near a chunk or in it: every split gives the same other scans."""
    if suffix == "parquet":
        pytest.importorskip("pyarrow")
    log, path = some_log("ages"), tmp_path / f"log.{suffix}"
    for damage in ("range", "scan"):
        column = getattr(log, damage).copy()
        column[log.start[bad] if damage == "range" else bad] = -1 if damage == "range" else 3
        with monkeypatch.context() as unchecked:
            unchecked.setattr(Log, "_check", lambda self: None)
            save_log(replace(log, **{damage: column}), path)
        whole, *others = (good_scans(str(path), scans) for scans in (40, 7, 3))
        assert len(whole) == 39
        for one in others:
            assert np.array_equal(one.scan, whole.scan)
            assert_same_evidence(one, whole)
