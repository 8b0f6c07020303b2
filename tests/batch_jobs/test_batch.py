"""Batches: the numbers of local models, the same bytes for every executor, and resumption after a kill."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.bags import firing_log, sonar_ring, spinning
from support.batches import JOB, RING, office_scans, one_shard
from support.commands import HEADER
from support.input_files import WALLS

from jaxsonar import Log, Room, SonarError, batch, load_log, local_models, save_log
from jaxsonar.batch_jobs import process_pool, worker_environment
from jaxsonar.batch_jobs.inputs import find_inputs
from jaxsonar.batch_jobs.manifest import open_manifest
from jaxsonar.batch_jobs.parquet_tables import TABLES, encode_parquet
from jaxsonar.batch_jobs.scan_tables import scan_tables
from jaxsonar.batch_jobs.shards import split_input
from jaxsonar.batch_jobs.worker import run_shard
from jaxsonar.detection.settings import hough_settings
from jaxsonar.scans.single_firings import group_firings

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
dataset = pytest.importorskip("pyarrow.dataset")

HOUGH: dict[str, Any] = {"method": "hough", "workers": 1, "shard_scans": 8}


def with_(**others: Any) -> dict[str, Any]:
    return HOUGH | others


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder with two logs."""
    folder = tmp_path_factory.mktemp("logs")
    save_log(office_scans(36), folder / "a.csv")
    save_log(office_scans(20, first=100), folder / "b.parquet")
    return folder


@pytest.fixture(scope="module")
def done(logs, tmp_path_factory):
    """The results of one worker without interruption."""
    folder = tmp_path_factory.mktemp("done")
    batch([logs], RING, folder, **HOUGH)
    return folder


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def table(folder, name):
    return pq.read_table(folder / name).to_pylist()


def manifest(folder):
    return [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]


def found(log, *, method, rows=None):
    rows = np.arange(len(log)) if rows is None else rows
    settings = hough_settings(RING, None)
    return scan_tables(RING, log, rows, source="log", method=method, settings=settings, sigma=None)


def as_rows(name, columns):
    return pq.read_table(pa.BufferReader(encode_parquet(name, columns))).to_pylist()


# Results


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ml", "hough"])
def test_the_numbers_are_those_of_local_models(method):
    log = office_scans(17)
    columns = found(log, method=method)
    scans, lines, points = (as_rows(name, columns[name]) for name in TABLES)
    models = list(local_models(RING, log, method=method))
    assert [row["scan"] for row in scans] == [model.scan for model in models]
    assert [row["empty"] or "" for row in scans] == [model.empty for model in models]
    wanted = [(model, line) for model in models for line in model.lines]
    assert len(lines) == len(wanted) > 30
    for row, (model, line) in zip(lines, wanted, strict=True):
        assert (row["scan"], row["rho"], row["theta"], row["echoes"]) == (model.scan, line.rho, line.theta, line.echoes)
        assert [[row["x1"], row["y1"]], [row["x2"], row["y2"]]] == line.segment.tolist()
        assert row["votes" if method == "hough" else "evidence"] == line.votes
        assert row["evidence" if method == "hough" else "votes"] is None
        cov = [[row["cov_rho"], row["cov_rho_theta"]], [row["cov_rho_theta"], row["cov_theta"]]]
        assert line.cov is None or cov == line.cov.tolist()
    if method == "hough":
        assert points == []
        return
    np.testing.assert_array_equal([row["sigma"] for row in scans], [model.sigma for model in models])
    decided = [row for row in points if row["kind"] != "undecided"]
    for row, (model, point) in zip(decided, [(m, p) for m in models for p in m.points], strict=True):
        assert (row["scan"], row["kind"], row["x"], row["y"]) == (model.scan, point.kind, point.x, point.y)
        assert [[row["cov_x"], row["cov_xy"]], [row["cov_xy"], row["cov_y"]]] == point.cov.tolist()
        assert row[f"p_{point.kind}"] == point.probability
    others = [row for row in points if row["kind"] == "undecided"]
    for row, (model, one) in zip(others, [(m, u) for m in models for u in m.undecided], strict=True):
        assert (row["scan"], row["rho"], row["theta"]) == (model.scan, one.rho, one.theta)
        assert (row["x"], row["y"]) == pytest.approx((one.x, one.y), rel=1e-6)
        assert {kind: row[f"p_{kind}"] for kind in one.probability} == one.probability
    assert [row["undecided"] for row in scans] == [len(model.undecided) for model in models]


@pytest.mark.slow
def test_each_table_opens_as_one_data_set_with_units(done):
    for name, columns in TABLES.items():
        seen = dataset.dataset(done / name)
        assert seen.schema.names == list(columns)
        for field in seen.schema:
            assert field.metadata[b"unit"].decode() == columns[field.name].unit
            assert field.metadata[b"about"]
    scans, lines = table(done, "scans"), table(done, "lines")
    assert [row["source"] for row in scans] == ["a.csv"] * 36 + ["b.parquet"] * 20
    assert [row["row"] for row in scans] == [*range(36), *range(20)]
    assert sum(row["lines"] for row in scans) == len(lines) > 50
    assert (scans[3]["echoes"], scans[3]["empty"]) == (0, "no echo within the maximum range")
    assert scans[4]["stamp"] is scans[4]["pose_x"] is None
    assert (done / "lines" / "a.csv-000004.parquet").exists()


# Reproducibility


@pytest.mark.slow
@pytest.mark.parametrize(("method", "sizes"), [("hough", (1, 5, 16)), ("ml", (5,))])
def test_shards_of_any_size_give_the_same_rows(method, sizes):
    """The result of a scan does not depend on the other scans, bit by bit."""
    log = office_scans(17)
    whole = found(log, method=method)
    for size in sizes:
        cuts = [np.arange(k, min(k + size, 17)) for k in range(0, 17, size)]
        parts = [found(log[int(cut[0]) : int(cut[-1]) + 1], method=method, rows=cut) for cut in cuts]
        for name in TABLES:
            assert [row for part in parts for row in as_rows(name, part[name])] == as_rows(name, whole[name])


@pytest.mark.slow
def test_two_workers_write_the_same_bytes(logs, done, tmp_path):
    told = []
    report = batch([logs], RING, tmp_path, **with_(workers=2), on_planned=told.append, on_done=told.append)
    assert contents(tmp_path) == contents(done)
    assert (told[0], told[-1], sorted(told[1:])) == (56, 56, told[1:])
    assert (report.scans, report.shards, report.resumed, report.set_aside) == (56, 8, 0, ())


@pytest.mark.slow
def test_a_dask_cluster_writes_the_same_bytes(logs, done, tmp_path):
    pytest.importorskip("distributed")
    names = (*worker_environment.MALLOC, *worker_environment.SINGLE_THREAD)
    before = [os.environ.get(name) for name in names]
    batch([logs], RING, tmp_path, engine="dask", **HOUGH)
    assert contents(tmp_path) == contents(done)
    assert [os.environ.get(name) for name in names] == before


@pytest.mark.slow
def test_a_folder_without_results_is_started_again(logs, done, tmp_path):
    pytest.importorskip("distributed")
    with pytest.raises(SonarError, match=r"nonsense.*allowed is an address"):
        batch([logs], RING, tmp_path, engine="dask", scheduler="nonsense://x", method="ml")
    batch([logs], RING, tmp_path, **HOUGH)
    assert contents(tmp_path) == contents(done)
    with pytest.raises(SonarError, match="before"):
        batch([logs], RING, tmp_path, method="ml")


@pytest.mark.slow
def test_a_killed_batch_is_resumed_with_the_same_bytes(logs, done, tmp_path):
    code = f"""
from jaxsonar import batch, load_ring
def wait(done):
    if done >= 16:
        print("now", flush=True)
        import time; time.sleep(60)
batch([{str(logs)!r}], load_ring("faw"), {str(tmp_path)!r}, on_done=wait, **{HOUGH})
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "now\n"
        with pytest.raises(SonarError, match="another batch is running there; allowed is one at a time"):
            batch([logs], RING, tmp_path, **HOUGH)
        process.send_signal(signal.SIGKILL)
    # Files that a process leaves when it is killed while writing.
    (tmp_path / "lines" / ".0123456789abcdef.tmp").write_bytes(b"half")
    (tmp_path / "lines" / "a.csv-000001.parquet").write_bytes(b"damaged")
    with open(tmp_path / "manifest.jsonl", "ab") as file:
        file.write(b'{"shard": "a.csv-0000')
    report = batch([logs], RING, tmp_path, **HOUGH)
    assert report.resumed == 1
    assert contents(tmp_path) == contents(done)


@pytest.mark.slow
def test_finished_shards_are_not_repeated(done, logs, monkeypatch):
    before = contents(done)
    monkeypatch.setattr(process_pool, "run_local", None)
    assert batch([logs], RING, done, **HOUGH).resumed == 8
    assert contents(done) == before


@pytest.mark.slow
def test_a_log_can_be_added(logs, done, tmp_path):
    shutil.copytree(done, tmp_path / "out")
    for line in (tmp_path / "out").rglob("b.parquet*"):
        line.unlink()
    lines = [line for line in manifest(done) if "b.parquet" not in json.dumps(line)]
    (tmp_path / "out" / "manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert batch([logs / "a.csv", logs / "b.parquet"], RING, tmp_path / "out", **HOUGH).resumed == 5
    assert contents(tmp_path / "out") == contents(done)


@pytest.mark.slow
@pytest.mark.parametrize("always", [False, True])
def test_a_shard_whose_process_dies_is_tried_once_more(logs, done, tmp_path, monkeypatch, always):
    """The first process, or every one, dies in the third shard of b."""
    code = f"""
import os, sys
from jaxsonar.batch_jobs import worker
work, flag = worker.run_shard, {str(tmp_path / "died")!r}
def run_shard(job, shard):
    if shard.key == "b.parquet-000002" and ({always} or not os.path.exists(flag)):
        open(flag, "w").close()
        os.kill(os.getpid(), 9)
    return work(job, shard)
worker.run_shard = run_shard
worker.worker_loop(int(sys.argv[1]))
"""
    monkeypatch.setattr(process_pool, "WORKER_CODE", code)
    report = batch([logs / "b.parquet"], RING, tmp_path / "out", **HOUGH)
    assert (tmp_path / "died").exists()
    if not always:
        expected = {name: data for name, data in contents(done).items() if "b.parquet" in name}
        assert contents(tmp_path / "out").items() >= expected.items()
        return
    assert (report.shards, report.set_aside_summary) == (2, "1 shard")
    assert report.set_aside == (f"b.parquet: {process_pool.WORKER_DIED}",)
    assert manifest(tmp_path / "out")[-1]["state"] == "set aside"
    monkeypatch.undo()
    assert not batch([logs / "b.parquet"], RING, tmp_path / "out", **HOUGH).set_aside, "it is tried again in a new run"


# Faulty inputs are set aside


BAD_ROWS = {
    "5,0.0,0,0,0,24,3,1.0\n": "scan 5: echo of sensors tx 24, rx 3; allowed are 0 to 23, the sensors of 'FAW ring'",
    "5,0.0,0,0,0,3,3,-1.0\n": "row 6, column range: '-1.0' came; allowed is a finite number of metres above 0",
    "5,0.0,0,0,0,3,3,nan\n": "row 6, column range: 'nan' came; allowed is a finite number of metres above 0",
    "5,0.0,0,0,0,3,3\n": "row 6: 7 columns came; allowed are 8, scan,stamp,x,y,theta,tx,rx,range",
    "5,0.0,0,,0,3,3,1.0\n": "row 6, column y: nothing came; allowed is finite x, y (m) and theta (rad), all three",
    "5,0.0,0,0,0,3,3,1.0\n5,0.1,0,0,0,4,4,1.0\n": "row 7, column stamp: '0.1' came; allowed is the same in every row",
    "2,0.0,0,0,0,3,3,1.0\n": "scan 2 came again; allowed is each scan number once",
}


@pytest.mark.parametrize(("bad", "why"), BAD_ROWS.items())
@pytest.mark.parametrize("scans", [100, 3])
def test_a_bad_row_sets_its_scan_aside_and_nothing_else(tmp_path, bad, why, scans):
    good = [f"{k},0.0,0,0,0,3,3,1.0\n" for k in range(8) if k != 5]
    path = tmp_path / "log.csv"
    path.write_text(HEADER + "".join(good[:4]) + bad + "".join(good[4:]))
    came = [run_shard(JOB, one) for one in split_input(*find_inputs([path]), staging=tmp_path, ring=RING, scans=scans)]
    assert [one.failure for one in came] == [""] * len(came)
    assert sum(one.bad_scans for one in came) == 1
    ((reason,),) = [one.reasons for one in came if one.bad_scans]
    assert reason.startswith("log.csv: ")
    assert why in reason
    rows = [row for one in came for row in pq.read_table(pa.BufferReader(one.tables["scans"])).to_pylist()]
    assert [row["scan"] for row in rows] == [0, 1, 2, 3, 4, 6, 7][: len(rows)]
    assert [row["row"] for row in rows] == [0, 1, 2, 3, 5, 6, 7] if "2,0.0" in bad else len(rows) == 7


def test_rows_without_a_scan_number_set_the_adjacent_scans_aside(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(HEADER + "0,,,,,1,1,1.0\n1,,,,,1,1,1.0\nrubbish\n2,,,,,1,1,1.0\n3,,,,,1,1,1.0\n4,,,,,1,1")
    came = run_shard(JOB, one_shard(path))
    assert came.bad_scans == 2
    assert came.reasons[0].startswith("log.csv: row 4: 1 columns came")
    assert came.reasons[1].startswith("log.csv: row 7: 7 columns came")
    assert pq.read_table(pa.BufferReader(came.tables["scans"]))["scan"].to_pylist() == [0, 3]


def test_bad_scans_of_parquet_are_set_aside(tmp_path):
    log = office_scans(12)
    save_log(log, tmp_path / "log.parquet")
    whole = load_log(tmp_path / "log.parquet")
    rows = pq.read_table(tmp_path / "log.parquet").to_pylist()
    rows[2]["echoes"][5]["range"] = -1.0
    rows[6]["scan"] = 1
    rows[9]["x"] = None
    rows[11]["echoes"][0]["tx"] = 99
    schema = pq.read_schema(tmp_path / "log.parquet")
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), tmp_path / "log.parquet", row_group_size=5)
    came = [
        run_shard(JOB, one)
        for one in split_input(*find_inputs([tmp_path / "log.parquet"]), staging=tmp_path, ring=RING, scans=4)
    ]
    assert [one.bad_scans for one in came] == [1, 1, 2]
    assert came[0].reasons[0].startswith("log.parquet: row 3, column echoes[5].range: -1.0 came")
    assert came[1].reasons == ["log.parquet: scan 1 came again; allowed is each scan number once"]
    assert came[2].reasons[0].startswith("log.parquet: row 10, column x, y, theta: [nan")
    assert "tx 99" in came[2].reasons[1]
    good = [k for k in range(12) if k not in (2, 6, 9, 11)]
    lines = [row for one in came for row in pq.read_table(pa.BufferReader(one.tables["lines"])).to_pylist()]
    alone = as_rows(
        "lines", found(Log.from_scans([whole[k] for k in good]), method="hough", rows=np.array(good))["lines"]
    )
    assert [row | {"source": ""} for row in lines] == [row | {"source": ""} for row in alone]


@pytest.mark.slow
def test_logs_that_cannot_be_read_are_set_aside_and_the_others_done(logs, done, tmp_path):
    folder = tmp_path / "logs"
    shutil.copytree(logs, folder)
    whole = (folder / "b.parquet").read_bytes()
    (folder / "cut.parquet").write_bytes(whole[: len(whole) // 2])
    ranges = pq.ParquetFile(folder / "b.parquet").metadata.row_group(0).column(7)  # their values, then their order
    begin = (ranges.dictionary_page_offset + ranges.data_page_offset) // 2
    (folder / "damaged.parquet").write_bytes(whole[:begin] + bytes(2000) + whole[begin + 2000 :])
    (folder / "path.csv").write_text("x,y,theta\n1,2,3\n")
    (folder / "noise.csv").write_bytes(bytes(range(256)) * 9000)
    (folder / "notes.txt").write_text("no log")
    out = tmp_path / "out"
    report = batch([folder], RING, out, **HOUGH)
    aside = {line["input"]: line["reason"] for line in manifest(out) if "input" in line and "reason" in line}
    assert aside.keys() == {"cut.parquet", "path.csv", "noise.csv"}
    assert all(reason.startswith(f"{source}: ") for source, reason in aside.items())
    assert report.bad_logs == 3
    assert report.bad_shards + report.bad_scans > 0, "values that cannot be right"
    expected = {name: data for name, data in contents(done).items() if name.endswith(".parquet")}
    assert contents(out).items() >= expected.items()


def test_a_log_that_changes_during_the_batch_is_set_aside(tmp_path):
    save_log(office_scans(8), tmp_path / "log.csv")
    one = one_shard(tmp_path / "log.csv")
    with open(tmp_path / "log.csv", "a") as file:
        file.write("99,,,,,,,\n")
    assert run_shard(JOB, one).failure.startswith("log.csv: changed during the batch")
    (tmp_path / "log.csv").unlink()
    assert run_shard(JOB, one).failure.startswith("log.csv: No such file or directory")


# Resuming with other inputs or parameters


@pytest.mark.slow
def test_other_parameters_are_rejected(logs, done):
    before = contents(done)
    other = replace(RING, neighbors=2)
    with pytest.raises(SonarError, match="another ring came; allowed is the ring and the settings of the first"):
        batch([logs], other, done, **HOUGH)
    with pytest.raises(SonarError, match='method "ml", before "hough", came'):
        batch([logs], RING, done, **with_(method="ml"))
    with pytest.raises(SonarError, match=r"b.parquet, which did not come"):
        batch([logs / "a.csv"], RING, done, **HOUGH)
    assert contents(done) == before


@pytest.mark.slow
def test_a_changed_log_is_rejected(logs, done, tmp_path):
    save_log(office_scans(36, first=1000), tmp_path / "a.csv")
    with pytest.raises(SonarError, match=r"a.csv: changed since .* was begun; allowed is the log as it was"):
        batch([tmp_path / "a.csv", logs / "b.parquet"], RING, done, **HOUGH)
    with pytest.raises(SonarError, match="two logs of one name came"):
        batch([tmp_path / "a.csv", logs], RING, tmp_path / "out", **HOUGH)


def test_a_folder_with_other_content_is_rejected(logs, tmp_path):
    (tmp_path / "lines").mkdir()
    (tmp_path / "lines" / "mine.parquet").write_bytes(b"")
    with pytest.raises(SonarError, match=r"tables without a manifest.jsonl lie there"):
        batch([logs], RING, tmp_path, **HOUGH)
    (tmp_path / "manifest.jsonl").write_text("hello\n")
    with pytest.raises(SonarError, match="this is no manifest of a batch"), open_manifest(tmp_path, {"batch": 1}):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("in_turn", [False, True], ids=["scans with times and ages", "one firing per scan"])
def test_the_split_does_not_change_the_results(tmp_path, in_turn):
    """Of a robot that turns while its sensors fire; every third reading of a scan repeats the one before."""
    ring = sonar_ring(16)
    pose_at = spinning((1.7, 1.3), np.radians(40))
    each = firing_log(ring, Room(WALLS), pose_at, np.arange(0.0, 6.0, 0.025))
    log = each if in_turn else with_repetitions(group_firings(each))
    save_log(log, tmp_path / "log.csv")
    save_log(log, tmp_path / "log.parquet")
    results = []
    for name, scans in (("log.csv", 3), ("log.csv", 100), ("log.parquet", 4)):
        folder = tmp_path / f"{name}-{scans}"
        report = batch([tmp_path / name], ring, folder, workers=1, shard_scans=scans)
        assert report.scans == 15
        results.append([{**row, "source": ""} for row in table(folder, "lines")])
    assert len(results[0]) > 30
    assert results[0] == results[1] == results[2]
    wanted = [
        line for model in local_models(ring, group_firings(load_log(tmp_path / "log.csv"))) for line in model.lines
    ]
    np.testing.assert_allclose([row["rho"] for row in results[0]], [line.rho for line in wanted], atol=1e-5)


def with_repetitions(log):
    """A log of equal scans in which every third sensor reports its reading of the scan before again, with its age."""
    columns = {name: getattr(log, name).copy() for name in ("range", "amplitude", "age")}
    old = np.flatnonzero((log.tx % 3 == 0) & (log.echo_scan % 2 == 1))
    fired = log.stamp[log.echo_scan] + log.t
    for name in ("range", "amplitude"):
        columns[name][old] = columns[name][old - 16]
    columns["age"][old] = fired[old] - fired[old - 16]
    return replace(log, **columns)
