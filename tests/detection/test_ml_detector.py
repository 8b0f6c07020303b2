"""Method ml from ranges and logs to walls, corners, edges and undecided reflectors; JSON; the command line.

Scans have at most 64 echoes and never come alone where they need not, so that little is compiled.
"""

import dataclasses
import json
import math

import numpy as np
import pytest
from support import oracles
from support.hard_cones import simulate

from jaxsonar import (
    HoughSettings,
    Log,
    Ring,
    Room,
    SonarError,
    extract_lines,
    kernels,
    load_log,
    local_model,
    local_models,
    random_pose,
    random_room,
    save_log,
)
from jaxsonar.cli import app as cli
from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.detection.settings import SETTINGS
from jaxsonar.sensors.ring_toml import load_ring
from jaxsonar.simulation.acoustics import Acoustics

RING = Ring.circular()
SCANS, ROOM = 16, 64


@pytest.fixture(scope="module")
def log():
    """Scans in different rooms: walls, corners, edges, noise of 3 mm, clutter."""
    return log_of(*(scan for scan in some_scans(60) if len(scan) <= ROOM))[:SCANS]


@pytest.fixture(scope="module")
def models(log):
    return list(local_models(RING, log))


def some_scans(count, ring=RING):
    for seed in range(count):
        rng = np.random.default_rng(seed)
        room = random_room(rng)
        came = simulate(ring, room, random_pose(rng, room)[None], sigma=0.003, dropout=0.1, clutter=0.1, seed=seed)
        yield list(zip(came.path.tolist(), came.range.tolist(), strict=True))


def log_of(*scans, ring=RING):
    """A log of scans that measured all paths, each a list of (path, range)."""
    index = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    flat = [echo for scan in scans for echo in scan]
    tx, rx = ring.paths[[k for k, _ in flat]].T if flat else np.zeros((2, 0), int)
    stamp, pose = np.arange(len(scans)) * 0.5, np.full((len(scans), 3), np.nan)
    ranges = np.array([r for _, r in flat], float)
    return Log.from_echoes(index, tx, rx, ranges, stamp=stamp, pose=pose, asked=ring.paths)


def dense_of(log, ring=RING, slots=4):
    """(scans, paths, slots) of a log."""
    ranges = np.full((len(log), len(ring.paths), slots), np.nan)
    used = np.zeros(ranges.shape[:2], int)
    for scan, path, reported in zip(log.echo_scan, ring.path_index[log.tx, log.rx], log.range, strict=True):
        ranges[scan, path, used[scan, path]] = reported
        used[scan, path] += 1
    return ranges


def written(model):
    return json.loads(json.dumps(model.as_json(), allow_nan=False))


def positive_definite(cov):
    cov = np.array(cov, float)
    assert cov.shape == (2, 2)
    np.testing.assert_allclose(cov, cov.T)
    return (np.linalg.eigvalsh(cov) > 0).all()


# lines of batches and models of logs


@pytest.mark.slow
def test_lines_equal_those_of_the_local_models(log, models):
    lines = extract_lines(RING, dense_of(log))
    assert lines.rho.shape == (SCANS, max(1, *(len(model.lines) for model in models)))
    for row, model in enumerate(models):
        count = len(model.lines)
        assert ((lines.echoes[row] > 0) == (np.arange(lines.rho.shape[1]) < count)).all()
        for k, line in enumerate(model.lines):
            assert lines.rho[row, k] == pytest.approx(line.rho, abs=1e-6)
            assert lines.theta[row, k] == pytest.approx(line.theta, abs=1e-6)
            assert lines.votes[row, k] == pytest.approx(line.votes, rel=1e-5)
            assert lines.echoes[row, k] == line.echoes
            np.testing.assert_allclose(lines.segments[row, k], line.segment, atol=1e-6)
            np.testing.assert_allclose(lines.cov[row, k], line.cov, rtol=1e-4)
        for name in ("rho", "theta", "votes", "segments", "cov"):
            assert np.isnan(getattr(lines, name)[row, count:]).all(), name


@pytest.mark.slow
def test_lines_are_sorted_normalized_and_padded(log):
    lines = extract_lines(RING, dense_of(log), sigma=0.003)
    there = lines.echoes > 0
    assert there.any(axis=1).sum() > SCANS / 2
    assert (np.isfinite(lines.rho) == there).all()
    assert (lines.rho[there] >= 0).all()
    assert ((lines.theta[there] >= -np.pi) & (lines.theta[there] < np.pi)).all()
    for row in range(SCANS):
        assert (np.diff(lines.votes[row][there[row]]) <= 0).all()
    assert lines.rho.dtype == np.float32
    assert lines.votes.dtype == np.float64
    assert lines.echoes.dtype == np.int64


@pytest.mark.slow
def test_unused_slots_do_not_change_the_lines(log):
    """The nearest two echoes of every path."""
    ranges = np.sort(dense_of(log), axis=2)
    two = ranges[:, :, :2]
    wide = np.concatenate([two, np.full_like(two, np.nan)], axis=2)
    narrow, same = extract_lines(RING, two), extract_lines(RING, wide)
    for field in dataclasses.fields(narrow):
        np.testing.assert_array_equal(getattr(narrow, field.name), getattr(same, field.name))


@pytest.mark.slow
def test_each_echo_is_explained_at_most_once(log, models):
    for row, model in enumerate(models):
        echoes = int((log.echo_scan == row).sum())
        parts = [*model.lines, *model.points, *model.undecided]
        assert parts
        assert sum(part.echoes for part in parts) <= echoes
        for part in parts:
            assert part.echoes >= len(part.paths) > 0
            assert (RING.path_index[tuple(part.paths.T)] >= 0).all()
        for k, line in enumerate(model.lines):
            assert line.rho >= 0
            assert -math.pi <= line.theta < math.pi
            assert line.scans == (row,)
            assert k == 0 or line.votes <= model.lines[k - 1].votes
            assert positive_definite(line.cov)
        for point in model.points:
            assert point.kind in ("corner", "edge")
            assert SETTINGS.min_probability <= point.probability <= 1
            assert positive_definite(point.cov)
        for reflector in model.undecided:
            assert set(reflector.probability) == set(KIND_NAMES)
            assert sum(reflector.probability.values()) == pytest.approx(1, abs=1e-4)
            assert reflector.rho >= 0
            assert -math.pi <= reflector.theta < math.pi
        assert bool(model.empty) == (not model.lines)
        assert 1e-4 <= model.sigma < 0.1


@pytest.mark.slow
def test_json_of_a_model_is_complete(models):
    assert any(model.points for model in models)
    assert any(model.undecided for model in models)
    for model in models:
        back = written(model)
        assert back["sigma"] == pytest.approx(model.sigma)
        for line, came in zip(model.lines, back["lines"], strict=True):
            assert set(came) == {"rho", "theta", "cov", "segment", "echoes", "evidence", "paths"}
            assert came["evidence"] == line.votes
            assert positive_definite(came["cov"])
            np.testing.assert_allclose(came["cov"], line.cov)
        for point, came in zip(model.points, back["points"], strict=True):
            assert set(came) == {"x", "y", "cov", "kind", "echoes", "probability", "paths"}
            assert (came["x"], came["y"], came["kind"]) == (point.x, point.y, point.kind)
            assert positive_definite(came["cov"])
        for reflector, came in zip(model.undecided, back["undecided"], strict=True):
            assert set(came) == {"rho", "theta", "x", "y", "probability", "echoes", "paths"}
            assert came["probability"] == reflector.probability
            assert came["echoes"] == reflector.echoes


@pytest.mark.slow
def test_method_hough_gives_no_points_noise_or_covariance(log):
    for model in local_models(RING, log, method="hough"):
        back = written(model)
        assert set(back) - {"empty"} == {"scan", "stamp", "lines"}
        assert math.isnan(model.sigma)
        assert model.points == model.undecided == ()
        for line, came in zip(model.lines, back["lines"], strict=True):
            assert set(came) == {"rho", "theta", "segment", "echoes", "votes", "paths"}
            assert came["votes"] == line.votes
            assert line.cov is None
    assert np.isnan(extract_lines(RING, dense_of(log), method="hough").cov).all()


@pytest.mark.slow
def test_a_known_noise_is_reported_and_scales_covariances(log):
    models = [list(local_models(RING, log, sigma=sigma)) for sigma in (0.003, 0.0033)]
    ratios = []
    for first, second in zip(*models, strict=True):
        assert (first.sigma, second.sigma) == (pytest.approx(0.003), pytest.approx(0.0033))
        for line in first.lines:
            twin = [other for other in second.lines if np.array_equal(other.paths, line.paths)]
            ratios += [np.diag(other.cov) / np.diag(line.cov) for other in twin if other.echoes == line.echoes]
    assert len(ratios) > SCANS
    np.testing.assert_allclose(np.median(ratios, axis=0), 1.21, rtol=0.05)


# kinds of reflectors


def test_a_corner_between_its_walls_is_reported():
    room = Room(np.array([[[1.2, 1.0], [-40, 1.0]], [[1.2, 1.0], [1.2, -40]]]))
    came = simulate(RING, room, np.zeros((2, 3)))
    scan = list(zip(came.path.tolist(), came.range.tolist(), strict=True))[: int((came.scan == 0).sum())]
    model, _ = local_models(RING, log_of(scan, []), sigma=0.001)
    assert len(model.lines) == 2
    for rho, theta in ((1.0, math.pi / 2), (1.2, 0.0)):
        nearest = min(model.lines, key=lambda line, to=theta: abs(oracles.wrap(line.theta - to)))
        assert nearest.rho == pytest.approx(rho, abs=2e-4)
        assert abs(oracles.wrap(nearest.theta - theta)) < 2e-3
    (point,) = model.points
    assert point.kind == "corner"
    assert math.hypot(point.x - 1.2, point.y - 1.0) < 0.001


@pytest.mark.slow
@pytest.mark.parametrize("corner", [True, False])
def test_direct_echoes_alone_do_not_distinguish_corner_and_edge(corner):
    ring = dataclasses.replace(RING, neighbors=0)
    place = np.array([1.0, 0.35])
    scan = [(path, reach) for _, path, reach in oracles.point_echoes(ring, np.zeros(3), place, corner=corner)]
    assert len(scan) >= 3
    model, nothing = local_models(ring, log_of(scan, [], ring=ring), sigma=0.001)
    assert model.points == model.lines == ()
    (reflector,) = model.undecided
    assert reflector.probability["corner"] > 0.1
    assert reflector.probability["edge"] > 0.1
    assert max(reflector.probability.values()) < SETTINGS.min_probability
    assert math.hypot(reflector.x, reflector.y) == pytest.approx(math.hypot(*place), abs=0.03)
    assert reflector.rho == pytest.approx(math.hypot(*place), abs=0.03)
    assert abs(oracles.wrap(reflector.theta - math.atan2(place[1], place[0]))) < 0.1
    (came,) = written(model)["undecided"]
    assert came["probability"] == reflector.probability
    assert model.empty == "no wall, only corners, edges and what is undecided"
    assert nothing.empty == "no echo within the maximum range"
    assert nothing.undecided == ()


def test_method_hough_takes_the_same_echoes_for_a_wall():
    """The motivation of method ml: method hough reports a pole as its strongest line."""
    loud = Acoustics(pole_strength=1.0)
    came = simulate(RING, Room(np.zeros((0, 2, 2)), poles=np.array([[1.0, 0.2]])), np.zeros((1, 3)), acoustics=loud)
    scan = list(zip(came.path.tolist(), came.range.tolist(), strict=True))
    paper, _ = local_models(RING, log_of(scan, []), method="hough")
    assert len(paper.lines) >= 1
    model, _ = local_models(RING, log_of(scan, []), sigma=0.001)
    assert model.lines == ()
    (point,) = model.points
    assert point.kind == "edge"


# invalid arguments


@pytest.mark.parametrize("sigma", [0.0, -0.001, 1e-7, 1.5, math.nan, math.inf])
def test_an_invalid_sigma_raises_a_one_line_error(sigma):
    nothing = np.full((1, len(RING.paths), 1), np.nan)
    for call in (
        lambda: extract_lines(RING, nothing, sigma=sigma),
        lambda: local_models(RING, log_of([]), sigma=sigma),
        lambda: local_model(RING, log_of([])[0], sigma=sigma),
    ):
        with pytest.raises(SonarError, match=r"^sigma .* m; allowed are 0.0001 to 1 m") as refused:
            call()
        assert len(str(refused.value).splitlines()) == 1


def test_an_unknown_method_raises_a_one_line_error():
    nothing = np.full((1, len(RING.paths), 1), np.nan)
    for call in (
        lambda: extract_lines(RING, nothing, method="best"),
        lambda: local_models(RING, log_of([]), method=""),
    ):
        with pytest.raises(SonarError, match=r"^method '.*'; allowed is ml or hough$"):
            call()


# the command line


def call(*arguments):
    """Exit code of one command, in this process."""
    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as end:
        return end.code


@pytest.mark.slow
def test_the_command_and_the_library_agree(log, tmp_path, capsys):
    save_log(log, tmp_path / "log.csv")
    arguments = ["lines", tmp_path / "log.csv", "--ring", "faw", "-o", tmp_path / "lines.jsonl"]
    assert call(*arguments, "--sigma", "0.003") == 0
    assert len(capsys.readouterr().err.splitlines()) == 1
    came = [json.loads(line) for line in (tmp_path / "lines.jsonl").read_text().splitlines()]
    ring = load_ring("faw")
    wanted = [written(model) for model in local_models(ring, load_log(tmp_path / "log.csv"), sigma=0.003)]
    assert len(came) == len(wanted) == SCANS
    for one, other in zip(came, wanted, strict=True):
        assert one["sigma"] == pytest.approx(0.003)
        assert [line["rho"] for line in one["lines"]] == pytest.approx([line["rho"] for line in other["lines"]])
        assert [point["kind"] for point in one["points"]] == [point["kind"] for point in other["points"]]
        assert len(one["undecided"]) == len(other["undecided"])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--sigma", "0"], ["--sigma", "'0'", "0.0001 to 1"]),
        (["--sigma", "-0.001"], ["--sigma", "-0.001"]),
        (["--sigma", "2"], ["--sigma", "'2'", "0.0001 to 1"]),
        (["--sigma", "nan"], ["--sigma", "nan", "0.0001 to 1"]),
        (["--sigma", "much"], ["--sigma", "much", "a number"]),
        (["--sigma"], ["--sigma", "one argument"]),
        (["--method", "best"], ["--method", "best", "ml", "hough"]),
    ],
)
def test_an_invalid_option_gives_one_line_and_exit_code_2(tmp_path, capsys, options, said):
    save_log(log_of([]), tmp_path / "log.csv")
    assert call("lines", tmp_path / "log.csv", "--ring", "faw", "-o", tmp_path / "lines.jsonl", *options) == 2
    came = capsys.readouterr()
    assert came.out == ""
    assert len(came.err.splitlines()) == 1
    for words in said:
        assert words in came.err
    assert not (tmp_path / "lines.jsonl").exists()


def test_kind_names_match_the_values_of_the_kernels():
    assert [KIND_NAMES[kind] for kind in (kernels.PLANE, kernels.CORNER, kernels.EDGE)] == ["plane", "corner", "edge"]
    assert HoughSettings().rho_cells == 100
    assert SETTINGS.min_probability > 0.5
