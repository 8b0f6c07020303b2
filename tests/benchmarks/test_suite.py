"""The benchmark suite: peers agree with the product, the gate detects regressions, results can be read back."""

import importlib
import itertools
import json
import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import __main__ as command
from benchmarks import markdown_tables, plots
from benchmarks.metrics import RATIO, Metric, Options, Results, failures, load_baseline, ratios, save_baseline
from benchmarks.speed import batch_at_scale, scaling, timing
from benchmarks.speed.baselines import FusedPeer, NumpyPeer, PointSetPeer, RasterPeer
from benchmarks.speed.scan_fixtures import batch, echoes_of, single_scans
from benchmarks.speed.timing import Contestant
from jaxsonar import HoughSettings, Ring, extract_lines, kernels
from jaxsonar.detection.arc_tables import arc_tables
from jaxsonar.scans.echo_batches import pack
from jaxsonar.scans.flat_echoes import FlatEchoes

SETTINGS = HoughSettings()
SCANS = 48


def walls(ring, rho, theta):
    """Ranges (paths, walls) of wide walls, received by all paths whose detection range contains their direction."""
    tx, rx = np.asarray(ring.position)[ring.paths.T]
    middle, half = (tx + rx) / 2, (rx - tx) / 2
    n, t = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    first, last = np.asarray(ring.detection_ranges, dtype=np.float64).T[..., None]
    distance = rho - middle @ n
    received = (distance > 0) & ((theta - first) % (2 * np.pi) < last - first)
    return np.where(received, np.hypot(distance, half @ t), np.nan).astype(np.float32)


@pytest.fixture(scope="module", params=["outward", "inward"])
def given(request):
    """Scans of rooms and of walls at the seam of theta, or a ring that faces inward with walls through its center."""
    ring = replace(Ring.circular(), range_offset=np.full(24, 0.004, np.float32))
    rng = np.random.default_rng(1)
    if request.param == "outward":
        seam = [walls(ring, rng.uniform(0.5, 1.8, 2), rng.normal(np.pi, 0.1, 2)) for _ in range(SCANS)]
        return ring, np.concatenate([batch(SCANS, ring=ring).dense, seam])
    ring = replace(ring, heading=np.asarray(ring.heading) + np.pi)
    middle = [walls(ring, rng.normal(0, 0.03, 2), rng.uniform(-np.pi, np.pi, 2)) for _ in range(2 * SCANS)]
    return ring, np.array(middle)


SHAPE = (SETTINGS.theta_cells, SETTINGS.rho_cells)


def product_votes(ring, ranges):
    """Votes and occupied cells by the kernels."""
    arcs, (votes, high) = arc_tables(ring, SETTINGS).arcs, np.zeros((2, len(ranges), *SHAPE), np.int64)
    echoes, pieces = FlatEchoes.from_dense(ring, ranges), arc_tables(ring, SETTINGS).pieces
    for step in pack(ring, echoes, SETTINGS.cells, pieces=pieces):
        real = slice(0, len(step.scans))
        votes[step.scans] = np.asarray(kernels.accumulators(arcs, step.packed, settings=SETTINGS)[0])[real]
        high[step.scans] = np.asarray(kernels.vote(arcs, step.packed, settings=SETTINGS).occupied)[real]
    return votes, high.astype(bool)


@pytest.mark.slow
@pytest.mark.parametrize("peer", ["numba", "numpy"])
def test_votes_and_occupied_cells_of_peers_equal_those_of_the_product(given, peer):
    ring, ranges = given
    votes, high = product_votes(ring, ranges)
    if peer == "numba":
        fused = FusedPeer(ring, SETTINGS)
        got, got_high = fused.votes(ranges), fused.occupied(ranges)
    else:
        plain = NumpyPeer(ring, SETTINGS)
        got = np.stack([plain.votes(scan)[0] for scan in ranges])
        got_high = np.stack([plain.occupied(one) for one in got])
    assert votes.sum() > 100_000
    assert high.any(axis=(1, 2)).mean() > 0.9
    outward = float(np.asarray(ring.position[0]) @ [np.cos(ring.heading[0]), np.sin(ring.heading[0])]) > 0
    assert (high[:, 0] & high[:, -1]).any() if outward else high[:, :, 0].any(axis=1).mean() > 0.5
    np.testing.assert_array_equal(got.sum(axis=(1, 2)), votes.sum(axis=(1, 2)))
    assert np.abs(got - votes).sum() <= 1e-4 * votes.sum()  # points on the border of a cell
    assert (got_high != high).sum() <= 1e-3 * high.sum()


@pytest.mark.slow
def test_the_numba_loop_finds_the_lines_of_the_product(given):
    ring, ranges = given
    lines = extract_lines(ring, ranges, method="hough")
    got = [column[:, : lines.rho.shape[1]] for column in FusedPeer(ring, SETTINGS).lines(ranges)]
    same = (lines.echoes == got[3]).all(axis=1)
    assert same.mean() > 0.95  # the rest has a point on the border of a cell, or two equally strong lines
    assert lines.echoes[same].astype(bool).sum() > 100
    for of, column in zip((lines.rho, lines.votes, lines.segments), (got[0], got[2], got[4]), strict=True):
        np.testing.assert_allclose(column[same], of[same], rtol=0, atol=3e-5)
    turn = (got[1] - lines.theta)[same]
    np.testing.assert_allclose(np.sin(turn / 2), 0 * turn, rtol=0, atol=2e-5)


@pytest.mark.slow
def test_plain_numpy_finds_the_lines_of_the_product(given):
    ring, ranges = given
    lines, plain = extract_lines(ring, ranges, method="hough"), NumpyPeer(ring, SETTINGS)
    same = 0
    for scan, rho, theta in zip(ranges, lines.rho, lines.theta, strict=True):
        some = np.isfinite(rho)
        want = np.stack([rho * np.cos(theta), rho * np.sin(theta), rho], axis=-1)[some]
        got = np.array([(r * np.cos(t), r * np.sin(t), r) for r, t in plain.lines(scan)]).reshape(-1, 3)
        near = np.abs(want[:, None] - got[None]).max(axis=-1).min(axis=1) if len(got) else np.full(len(want), 1.0)
        same += len(want) == len(got) and bool((near < 1e-4).all())
    assert same > 0.95 * len(ranges)


@pytest.mark.slow
def test_points_lie_on_the_arcs(given):
    """The transform of OpenCV gets one point for each tangent of the product, on the same arc."""
    ring, ranges = given
    peer, scan = PointSetPeer(ring, SETTINGS), ranges[0]
    path, slot = np.nonzero(np.isfinite(scan))
    points = peer.points(scan)[:, 0]
    votes, _ = product_votes(ring, scan[None])
    assert len(points) == votes.sum()
    arcs, paths = arc_tables(ring, SETTINGS).arcs, ring.echo_paths
    counts, theta = np.asarray(arcs.arcs.exists), np.asarray(arcs.arcs.theta)
    begin = 0
    for p, s in itertools.islice(zip(path, slot, strict=True), 5):
        own = points[begin : begin + counts[p].sum()]
        begin += len(own)
        reach = ring.corrected(scan[None, p, s], *ring.paths[p : p + 1].T)[0]
        one = jax.tree.map(lambda leaf, row=p: jnp.asarray(leaf)[row], paths)
        want = [kernels.arc_point(one, jnp.float32(reach), jnp.asarray(angle)) for angle in theta[p][counts[p]]]
        np.testing.assert_allclose(own, np.array(want), rtol=0, atol=1e-5)
    assert peer.lines(peer.points(scan)) is not None
    image = RasterPeer(SETTINGS).raster(peer.points(scan))
    assert 0.01 * len(points) < image.sum() <= len(points)


@pytest.mark.slow
def test_batches_have_the_stated_numbers_of_echoes():
    some = batch(60)
    assert some.mixed.shape == some.dense.shape == (60, 168, 2)
    assert 40 < echoes_of(some.mixed).mean() < 55
    assert 55 < echoes_of(some.dense).mean() < 75
    scans = single_scans(some.ring, some.dense)
    assert [len(scan.range) for scan in scans] == echoes_of(some.dense).tolist()
    for count in (8, 128):
        made = scaling.with_echoes(some.dense, count, np.random.default_rng(0))
        assert set(echoes_of(made).tolist()) == {count}


def test_ratios_are_those_of_the_amounts_of_work():
    """On a machine that becomes slower, twice the work for the same number of scans takes twice the time."""
    now, order = [0.0], []

    def work(name, amount):
        order.append(name)
        now[0] += amount * 1.01 ** len(order)

    entered = {"one": Contestant(lambda: work("one", 1.0), 4), "two": Contestant(lambda: work("two", 2.0), 4)}
    entered["many"] = Contestant(lambda: work("many", 20.0), 40)
    taken = timing.round_robin(entered, rounds=8, clock=lambda: now[0])
    assert order == [*entered, *([*entered, *[*entered][::-1]] * 4)]  # once to warm up, then in turn
    assert timing.ratio(taken["two"], taken["one"]) == pytest.approx(2, rel=0.02)
    assert timing.ratio(taken["many"], taken["two"]) == pytest.approx(1, rel=0.02)
    assert scaling.exponent([(n, 3e-6 * n**1.5) for n in (10, 100, 1000, 10_000)]) == pytest.approx(1.5)


def results(**values):
    """As a run gives them."""
    metrics = [
        Metric("throughput.hough:numba", values.get("numba", 1.4), RATIO, "higher", 2.0, 1.0),
        Metric("throughput.hough:numpy", 12.0, RATIO, "higher", 2.0, 10.0),
        Metric("throughput.ml:hough", values.get("ml", 2.5), RATIO, "lower", 2.0, 3.0),
        Metric("throughput.ml.two:one.processes", float("nan"), RATIO, "higher", None, 1.8),
        Metric("throughput.hough.rate", 31_000.0, "scans/s", "higher"),
        Metric("latency.hough.p50", 0.8, "ms", target=1.0),
        *(
            Metric(f"stages.hough.{k}.share", share, "%")
            for k, share in {"pack": 3, "votes": 60, "centroids": 30}.items()
        ),
        *(Metric(f"stages.hough.{k}", 10.0, "us/scan") for k in ("whole", "pack", "votes", "centroids")),
        Metric("growth.scans.hough.exponent", 1.02, ""),
        *(Metric(f"growth.scans.hough@{n}", 30 + 100 / n, "us/scan") for n in (16, 64, 256)),
    ]
    return Results.of(metrics, {"size": "quick", "seed": 0})


def test_results_come_back_and_say_where_they_are_from(tmp_path):
    saved_results = results()
    saved_results.save(tmp_path / "suite.json")
    raw = json.loads((tmp_path / "suite.json").read_text(), parse_constant=pytest.fail)
    assert {"device", "platform", "processor", "cores", "python", "jax", "jaxlib", "numpy", "commit", "time"} <= set(
        raw["environment"]
    )
    assert raw["environment"]["opencv-python-headless"]
    assert raw["options"] == {"size": "quick", "seed": 0}
    again = Results.load(tmp_path / "suite.json")
    assert list(again.metrics) == list(saved_results.metrics)
    assert all(repr(again.metrics[key]) == repr(one) for key, one in saved_results.metrics.items())
    assert math.isnan(again.value("throughput.ml.two:one.processes"))
    assert again.environment == saved_results.environment


def test_the_gate_passes_on_itself_and_fails_on_worse(tmp_path):
    path = tmp_path / "baseline.json"
    save_baseline(results(), path)
    held = load_baseline(path)
    assert set(held["ratios"]) == set(ratios(results().metrics.values()))
    assert "throughput.hough.rate" not in held["ratios"]  # only ratios are in the baseline
    assert failures(results().metrics, held) == {}
    assert failures(results(numba=2.9, ml=0.1).metrics, held) == {}
    assert failures(results(numba=0.75, ml=4.9).metrics, held) == {}
    assert set(failures(results(numba=0.65).metrics, held)) == {"throughput.hough:numba"}
    assert set(failures(results(ml=5.1).metrics, held)) == {"throughput.ml:hough"}
    assert set(failures({}, held)) == set(held["ratios"])
    assert failures({}, held, only=["latency"]) == {}


def test_the_gate_takes_the_best_of_three_attempts(tmp_path, monkeypatch):
    path = tmp_path / "baseline.json"
    save_baseline(results(), path)
    tries = iter([results(numba=0.1, ml=2.0), results(numba=0.2, ml=99.0), results(numba=0.9)])
    monkeypatch.setattr(command, "measured", lambda names, options: list(next(tries).metrics.values()))
    best, wrong = command.gate(["throughput"], Options("gate"), path)
    assert wrong == []
    assert best["throughput.hough:numba"].value == 0.9
    assert best["throughput.ml:hough"].value == 2.0
    monkeypatch.setattr(command, "measured", lambda names, options: list(results(numba=0.1).metrics.values()))
    call = ["--gate", "--only", "throughput", "--baseline", str(path), "-o", str(tmp_path)]
    assert command.main(call) == 1
    monkeypatch.setattr(command, "measured", lambda names, options: list(results().metrics.values()))
    assert command.main(call) == 0


def test_the_committed_baseline_matches_the_workloads_of_the_gate():
    """It has only ratios, of the workloads of the gate, and the environment."""
    held = load_baseline()
    assert {"device", "jax", "jaxlib", "numpy", "commit"} <= set(held["environment"])
    assert {key.partition(".")[0] for key in held["ratios"]} == set(command.DEFAULT_WORKLOADS["gate"])
    assert all(was["tolerance"] >= 2 and was["value"] > 0 for was in held["ratios"].values())


def test_targets():
    assert Metric("", 1.0, RATIO, "higher", target=1.0).met
    assert not Metric("", 3.1, "ms", target=3.0).met
    assert Metric("", 3.1, "ms").met is None
    assert Metric("", float("nan"), "ms", target=3.0).met is None


@pytest.mark.slow
def test_updating_a_page_is_idempotent(tmp_path):
    end = "<!-- /benchmarks -->\n"
    text = f"a\n<!-- benchmarks: targets -->\nold\n{end}b\n<!-- benchmarks: device -->\nkept\n{end}"
    path = tmp_path / "page.md"
    path.write_text(text)
    markdown_tables.write(path, results())
    made = path.read_text()
    assert "| hough, batch, one core : plain NumPy + OpenCV | 12 x | at least 10 x | yes |" in made
    assert "| ml, two cores : one core | not measured here | at least 1.8 x |  |" in made
    assert "old" not in made
    assert "kept" in made
    markdown_tables.write(path, results())
    assert path.read_text() == made
    path.write_text(text.replace("targets", "goals"))
    assert command.main(["--from", str(saved(tmp_path)), "-o", str(tmp_path), "--write", str(path)]) == 2


def saved(folder):
    results().save(folder / "some.json")
    return folder / "some.json"


@pytest.mark.slow
def test_figures_and_tables_from_saved_results(tmp_path, capsys):
    command.main(["--from", str(saved(tmp_path)), "-o", str(tmp_path)])
    names = {path.name for path in tmp_path.iterdir()}
    assert {f"{name}.{suffix}" for name in ("peers", "stages", "growth") for suffix in ("svg", "png")} <= names
    assert "throughput.hough:numba" in capsys.readouterr().out
    empty = replace(results(), metrics={})
    assert plots.all_of(empty) == {}
    assert all(block(empty) for block in markdown_tables.BLOCKS.values())


def test_every_workload_is_a_function():
    for function, _ in command.WORKLOADS.values():
        module, _, name = function.rpartition(".")
        assert callable(getattr(importlib.import_module(f"benchmarks.{module}"), name)), function


def test_workloads_are_listed(capsys):
    command.main(["--list"])
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(command.WORKLOADS)
    assert all(set(names) <= set(command.WORKLOADS) for names in command.DEFAULT_WORKLOADS.values())


@pytest.mark.slow
def test_a_killed_and_continued_run_has_the_tables_of_an_uninterrupted_one(tmp_path):
    whole, killed = batch_at_scale.measure(tmp_path, scans=96, each=48, engines=["local"])
    assert whole["same"]
    assert killed["same"]
    assert "not in its middle" in killed["run"] or 0 < killed["shards"] < 2
    assert whole["rate"] > 0
    (tmp_path / "killed" / "lines" / "other.parquet").write_bytes(b"")
    assert not batch_at_scale.same_tables(tmp_path / "local", tmp_path / "killed")


@pytest.mark.parametrize(
    "call", [["--from", "{}"], ["--gate", "--baseline", "{}"], ["--only", "latency", "--write", "{}/no.md"]]
)
@pytest.mark.parametrize("holds", [None, "{", "[]", "{}"])
def test_foreign_files_are_refused_before_measuring(call, holds, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(command, "measured", lambda *_: pytest.fail("it measured"))
    file = tmp_path / "file.json"
    if holds is not None:
        file.write_text(holds)
    assert command.main([*(one.format(file) for one in call), "-o", str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "needed" in message


def test_a_baseline_is_the_median_of_several_runs():
    runs = [[Metric("a", value, RATIO), Metric("b", -value, RATIO)] for value in (3.0, 1.0, 2.0)]
    assert [one.value for one in command.medians(runs)] == [2.0, -2.0]
