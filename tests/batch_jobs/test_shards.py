"""Shards: chunks of logs give the same rows as the whole log, in bounded memory."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from support.batches import JOB, RING, office_scans, one_shard

from jaxsonar import Log, load_log, save_log
from jaxsonar.batch_jobs.inputs import Input, find_inputs
from jaxsonar.batch_jobs.parquet_tables import TABLES
from jaxsonar.batch_jobs.shard_reader import read_shard
from jaxsonar.batch_jobs.shards import split_input
from jaxsonar.batch_jobs.worker import run_shard
from jaxsonar.scans.log_chunks import csv_chunk_reader, csv_chunks, parquet_chunk_reader, parquet_chunks
from jaxsonar.scans.log_parts import concatenate
from jaxsonar.scans.measured_paths import measured_paths

pa = pytest.importorskip("pyarrow")


pq = pytest.importorskip("pyarrow.parquet")


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("scans", [1, 7, 50])
def test_chunks_concatenate_to_the_log(tmp_path, suffix, scans):
    log, path = office_scans(40), tmp_path / f"log.{suffix}"
    save_log(log, path)
    plan, reader = (csv_chunks, csv_chunk_reader) if suffix == "csv" else (parquet_chunks, parquet_chunk_reader)
    parts = plan(path, name="log", scans=scans)
    assert [part.first for part in parts] == list(range(0, 40, scans))
    read = [reader(path, part, name="log")(0, part.scans) for part in parts]
    assert Log.from_scans([scan for one in read for scan in one]) == log == load_log(path)


@pytest.mark.slow
def test_csv_and_parquet_give_the_same_rows(tmp_path):
    log = office_scans(10)
    save_log(log, tmp_path / "log.csv")
    save_log(log, tmp_path / "log.parquet")
    text = (tmp_path / "log.csv").read_bytes()
    (tmp_path / "log.windows.csv").write_bytes(b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n").removesuffix(b"\r\n"))
    came = [run_shard(JOB, one_shard(tmp_path / name)) for name in ("log.csv", "log.parquet", "log.windows.csv")]
    for name in TABLES:
        rows = [pq.read_table(pa.BufferReader(one.tables[name])).drop_columns("source").to_pylist() for one in came]
        assert rows[0] == rows[1] == rows[2]


def test_scans_may_come_in_any_order(tmp_path):
    log = office_scans(9)
    mixed = Log.from_scans([log[k] for k in (5, 2, 8, 0, 1, 7, 3, 6, 4)])
    save_log(mixed, tmp_path / "log.csv")
    assert not any(part.repeated for part in csv_chunks(tmp_path / "log.csv", name="log", scans=4))
    rows = pq.read_table(pa.BufferReader(run_shard(JOB, one_shard(tmp_path / "log.csv")).tables["scans"]))
    assert rows["scan"].to_pylist() == mixed.scan.tolist()


def test_a_log_without_scans_has_no_shards(tmp_path):
    for name in ("log.csv", "log.parquet"):
        save_log(Log.from_scans([]), tmp_path / name)
    assert [split_input(one, staging=tmp_path, ring=RING) for one in find_inputs([tmp_path])] == [[], []]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_planning_takes_bounded_memory(tmp_path, suffix, monkeypatch):
    """Four times the scans, the same memory."""
    monkeypatch.setattr("jaxsonar.scans.log_chunks.BLOCK", 1 << 16)
    monkeypatch.setattr("jaxsonar.scans.log_chunks.ROWS_PER_READ", 1 << 10)
    path, peaks = tmp_path / f"log.{suffix}", []
    for scans in (10_000, 40_000):
        echo = np.arange(scans * 4)
        sensor, index = echo % 24, echo // 4
        none = np.full((scans, 3), np.nan)
        log = Log.from_echoes(index, sensor, sensor, 1 + 0.001 * (echo % 7), stamp=none[:, 0], pose=none)
        save_log(log, path)
        del log
        plan = csv_chunks if suffix == "csv" else parquet_chunks
        before = pa.total_allocated_bytes()
        tracemalloc.start()
        assert sum(part.scans for part in plan(path, name="log", scans=2048)) == scans
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert pa.total_allocated_bytes() - before < 1e6
    assert peaks[1] < 1.3 * peaks[0] + 1e5


def test_large_row_groups_are_staged(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxsonar.batch_jobs.shards.MAX_ROW_GROUP", 8)
    save_log(office_scans(20), tmp_path / "log.parquet")
    parts = split_input(*find_inputs([tmp_path / "log.parquet"]), staging=tmp_path / "copies", ring=RING, scans=4)
    assert parts[0].filename == str(tmp_path / "copies" / "log.parquet.parquet")
    assert pq.ParquetFile(parts[0].filename).metadata.num_row_groups == 5
    assert load_log(parts[0].filename) == load_log(tmp_path / "log.parquet")


def test_a_staged_copy_keeps_what_the_log_measured(tmp_path, monkeypatch):
    """An explicit log without a silent reading, as of a device that only reports echoes and names what it measured."""
    whole = office_scans(20)
    explicit = Log.from_scans([replace(scan, asked=np.zeros((0, 2), np.int64)) for scan in whole])
    assert not measured_paths(RING, explicit).all()
    monkeypatch.setattr("jaxsonar.batch_jobs.parquet_staging.load_log_with_warnings", lambda *_, **more: explicit)
    (tmp_path / "run.mcap").write_bytes(b"")
    log = Input("run.mcap", str(tmp_path / "run.mcap"), "record")
    for scans in (7, 20):
        parts = split_input(log, staging=tmp_path / "copies", ring=RING, scans=scans)
        read = concatenate([read_shard(part, RING)[0] for part in parts])
        assert np.array_equal(measured_paths(RING, read), measured_paths(RING, explicit))


def test_keys_are_valid_filenames_and_distinct():
    keys = [
        Input(name, "", "csv").key for name in ("a.csv", "a b.csv", "a_b.csv", "_a.csv", "ä.csv", ".a.csv", "x" * 300)
    ]
    assert len(set(keys)) == len(keys)
    assert keys[0] == "a.csv"
    assert all(key[0].isalnum() and key.isascii() and len(key) < 120 for key in keys)
