"""Method hough against the slow oracle; symmetries under rotation, reflection, padding and batching; errors.

Method hough throughout; method ml has test_explained.
"""

import dataclasses
import json
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracles
from support.rings import bumper_ring

import jaxsonar
from jaxsonar import HoughSettings, Log, Ring, SonarError, kernels
from jaxsonar.detection.arc_tables import arc_tables

extract_lines = partial(jaxsonar.extract_lines, method="hough")
local_model = partial(jaxsonar.local_model, method="hough")
local_models = partial(jaxsonar.local_models, method="hough")

THREE_WALLS = [(1.2, 0.3), (1.7, -1.9), (1.5, 3.1)]
TURNED_RING = Ring.circular(count=32, beam=1.5, neighbors=4, first_heading=0.0123)  # no point at the border of a cell
BUMPER = bumper_ring()


def dense(ring, echoes, slots=3):
    """(1, paths, slots) from a list of (path, reported)."""
    ranges = np.full((1, len(ring.paths), slots), np.nan, np.float32)
    used = np.zeros(len(ring.paths), int)
    for path, reported in echoes:
        ranges[0, path, used[path]] = reported
        used[path] += 1
    return ranges


def a_scan(ring, rng, walls=THREE_WALLS, noise=0.003, false=10):
    """Noisy echoes of infinite walls, and clutter."""
    echoes = [(k, r + rng.normal(0, noise)) for wall in walls for k, r in oracles.echoes_of_wall(ring, *wall)]
    return echoes + [(int(k), float(rng.uniform(0.2, 2.2))) for k in rng.integers(0, len(ring.paths), false)]


def as_log(ring, scans):
    index = np.repeat(np.arange(len(scans)), [len(scan) for scan in scans])
    flat = [echo for scan in scans for echo in scan]
    tx, rx = ring.paths[[k for k, _ in flat]].T if flat else np.zeros((2, 0), int)
    reported = np.array([r for _, r in flat], float)
    return Log.from_echoes(
        index, tx, rx, reported, stamp=np.arange(len(scans)) * 0.5, pose=np.full((len(scans), 3), np.nan)
    )


def found(lines, scan=0):
    count = int((lines.echoes[scan] > 0).sum())
    columns = (lines.rho, lines.theta, lines.votes, lines.echoes)
    return [tuple(column[scan, k] for column in columns) for k in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("ring", [Ring.circular(), TURNED_RING, BUMPER])
def test_lines_agree_with_the_slow_oracle(ring, seed):
    rng = np.random.default_rng(seed)
    setup = HoughSettings(rho_cells=100 if ring is not BUMPER else 120)
    echoes = a_scan(ring, rng)
    lines = extract_lines(ring, dense(ring, echoes, 6), settings=setup)
    level = setup.threshold * float(kernels.full_wall_votes(ring.echo_paths, setup))
    wanted = oracles.hough_lines(ring, [(k, float(np.float32(r))) for k, r in echoes], setup, level)
    assert len(wanted) > 0
    came = found(lines)
    assert len(came) == len(wanted)
    for k, (line, (rho, theta, votes, count, ends)) in enumerate(zip(came, wanted, strict=True)):
        # A point on the border of two cells may round into the other one in single precision.
        assert line[2] == pytest.approx(votes, abs=2)
        assert line[3] == pytest.approx(count, abs=1)
        assert line[0] == pytest.approx(rho, abs=2e-4)
        assert abs(oracles.wrap(line[1] - theta)) < 2e-4
        np.testing.assert_allclose(lines.segments[0, k], ends, atol=1e-3)


@pytest.mark.slow
def test_walls_are_detected_at_their_positions(faw_ring):
    echoes = [(k, r) for wall in THREE_WALLS for k, r in oracles.echoes_of_wall(faw_ring, *wall)]
    came = found(extract_lines(faw_ring, dense(faw_ring, echoes)))
    assert len(came) == 3
    for rho, theta in THREE_WALLS:
        nearest = min(came, key=lambda line: abs(oracles.wrap(line[1] - theta)))
        assert nearest[0] == pytest.approx(rho, abs=0.0323)  # the paper's largest deviations
        assert abs(np.degrees(oracles.wrap(nearest[1] - theta))) < 7.4149


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 10_000), st.integers(0, 23))
def test_rotation_by_sensor_steps_permutes_paths_and_shifts_theta(seed, steps):
    """A step of 15 deg is an integer number of cells of 3 deg; therefore only theta changes."""
    ring, setup = Ring.circular(), HoughSettings(theta_cells=120)
    echoes = a_scan(ring, np.random.default_rng(seed))
    turned = [(int(ring.path_index[tuple((ring.paths[k] - steps) % 24)]), r) for k, r in echoes]
    lines = extract_lines(ring, np.concatenate([dense(ring, echoes, 6), dense(ring, turned, 6)]), settings=setup)
    here, there = found(lines, 0), found(lines, 1)
    assert len(here) == len(there) > 0
    for line in here:
        theta = oracles.wrap(line[1] - steps * np.radians(15))
        twin = min(there, key=lambda other: abs(oracles.wrap(other[1] - theta)) + abs(other[0] - line[0]))
        assert abs(oracles.wrap(twin[1] - theta)) < 1e-3
        assert twin[0] == pytest.approx(line[0], abs=1e-3)
        assert twin[2] == pytest.approx(line[2], abs=2)


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_a_mirrored_room_gives_mirrored_lines(seed):
    ring = Ring.circular()
    echoes = a_scan(ring, np.random.default_rng(seed))
    mirrored = [(int(ring.path_index[tuple(-ring.paths[k] % 24)]), r) for k, r in echoes]
    lines = extract_lines(ring, np.concatenate([dense(ring, echoes, 6), dense(ring, mirrored, 6)]))
    here, there = found(lines, 0), found(lines, 1)
    assert len(here) == len(there) > 0
    for line in here:
        twin = min(there, key=lambda other: abs(oracles.wrap(other[1] + line[1])) + abs(other[0] - line[0]))
        assert abs(oracles.wrap(twin[1] + line[1])) < 1e-3
        assert twin[0] == pytest.approx(line[0], abs=1e-3)
        assert twin[2] == pytest.approx(line[2], abs=2)


def test_both_directions_of_a_pair_give_the_same_lines(faw_ring, rng):
    echoes = a_scan(faw_ring, rng)
    swapped = [(int(faw_ring.path_index[tuple(faw_ring.paths[k][::-1])]), r) for k, r in echoes]
    lines = extract_lines(faw_ring, np.concatenate([dense(faw_ring, echoes, 6), dense(faw_ring, swapped, 6)]))
    np.testing.assert_allclose(lines.theta[0], lines.theta[1], atol=1e-3)
    np.testing.assert_allclose(lines.rho[0], lines.rho[1], atol=1e-3)


@pytest.mark.slow
def test_lines_are_equal_for_single_scans_batches_and_logs(faw_ring, rng):
    scans = [a_scan(faw_ring, rng, false=int(rng.integers(0, 60))) for _ in range(300)]
    scans[7] = []
    ranges = np.concatenate([dense(faw_ring, scan, 8) for scan in scans])
    batch = extract_lines(faw_ring, ranges)
    for k in (0, 7, 123, 299):
        alone = extract_lines(faw_ring, ranges[k : k + 1])
        count = int((alone.echoes[0] > 0).sum())
        for name in ("rho", "theta", "votes", "echoes", "segments"):
            np.testing.assert_array_equal(getattr(batch, name)[k, :count], getattr(alone, name)[0, :count])
        assert not batch.echoes[k, count:].any()
    log = as_log(faw_ring, scans)
    models = list(local_models(faw_ring, log))
    assert [model.scan for model in models] == list(range(300))
    for k, model in enumerate(models):
        np.testing.assert_allclose([line.rho for line in model.lines], batch.rho[k][batch.echoes[k] > 0], atol=1e-5)
    one = local_model(faw_ring, log[123])
    assert [line.rho for line in one.lines] == [line.rho for line in models[123].lines]
    assert one.stamp == 61.5


def test_lines_do_not_depend_on_the_order_of_echoes(faw_ring, rng):
    ranges = dense(faw_ring, a_scan(faw_ring, rng), 6)
    shuffled = np.concatenate([np.full((1, 168, 2), np.nan, np.float32), ranges[:, :, ::-1]], axis=2)
    first, second = extract_lines(faw_ring, ranges), extract_lines(faw_ring, shuffled)
    np.testing.assert_array_equal(first.votes, second.votes)
    np.testing.assert_allclose(first.rho, second.rho, atol=1e-5)
    np.testing.assert_allclose(first.theta, second.theta, atol=1e-5)


def test_lines_are_sorted_and_padded(faw_ring, rng):
    ranges = np.concatenate([dense(faw_ring, []), dense(faw_ring, a_scan(faw_ring, rng))])
    lines = extract_lines(faw_ring, ranges)
    assert np.isnan(lines.rho[0]).all()
    assert (np.diff(lines.votes[1][lines.echoes[1] > 0]) <= 0).all()
    assert ((lines.echoes > 0) == np.isfinite(lines.rho)).all()
    assert ((lines.theta >= -np.pi) & (lines.theta < np.pi) | np.isnan(lines.theta)).all()


def test_no_scans_give_no_lines(faw_ring):
    lines = extract_lines(faw_ring, np.zeros((0, 168, 2), np.float32))
    assert lines.rho.shape == (0, 1)
    lines = extract_lines(faw_ring, np.zeros((3, 168, 0), np.float32))
    assert lines.rho.shape == (3, 1)
    assert list(local_models(faw_ring, as_log(faw_ring, []))) == []


def test_no_echoes_give_no_wall(faw_ring):
    """Missing echoes, and maximum ranges that some devices write instead, give no line."""
    everywhere = np.full((1, 168, 1), faw_ring.max_range, np.float32)
    assert not extract_lines(faw_ring, everywhere).echoes.any()
    assert not extract_lines(faw_ring, everywhere + 3).echoes.any()


@pytest.mark.parametrize(
    ("echoes", "why"),
    [
        ([], "no echo within the maximum range"),
        ([(0, 2.5)], "no echo within the maximum range"),
        ([(0, 1.0), (1, 1.0)], "fewer than 3 echoes"),
        ([(0, 1.0), (5, 1.5), (10, 0.6), (15, 1.8)], "no c"),
    ],
)
def test_an_empty_model_states_the_reason(faw_ring, echoes, why):
    model = next(local_models(faw_ring, as_log(faw_ring, [echoes])))
    assert model.lines == ()
    assert why in model.empty
    assert model.as_json()["empty"] == model.empty


def test_involved_sensors_bound_the_segment(faw_ring):
    model = next(local_models(faw_ring, as_log(faw_ring, [oracles.echoes_of_wall(faw_ring, 1.2, 0.3)])))
    (line,) = model.lines
    assert line.echoes == len(line.paths)
    middle = faw_ring.position[line.paths].mean(axis=1)
    n = np.array([np.cos(line.theta), np.sin(line.theta)])
    feet = middle + (line.rho - middle @ n)[:, None] * n
    span = feet @ np.array([-n[1], n[0]])
    np.testing.assert_allclose(line.segment[0], feet[span.argmin()], atol=1e-5)
    np.testing.assert_allclose(line.segment[1], feet[span.argmax()], atol=1e-5)


def test_json_is_complete(faw_ring, rng):
    (model,) = local_models(faw_ring, as_log(faw_ring, [a_scan(faw_ring, rng)]))
    back = json.loads(json.dumps(model.as_json(), allow_nan=False))
    assert back["scan"] == 0
    assert back["stamp"] == 0.0
    for line, written in zip(model.lines, back["lines"], strict=True):
        assert written["rho"] == line.rho
        assert written["theta"] == line.theta
        assert written["echoes"] == line.echoes
        np.testing.assert_allclose(written["segment"], line.segment)
        np.testing.assert_array_equal(written["paths"], line.paths)
    assert "stamp" in dataclasses.replace(model, stamp=float("nan")).as_json()


def test_offsets_and_speed_of_sound_are_corrected():
    plain = Ring.circular()
    ring = dataclasses.replace(plain, range_offset=np.linspace(0.0, 0.1, 24), speed_of_sound=350.0)
    echoes = oracles.echoes_of_wall(plain, 1.1, 0.7)
    reported = [(k, r * 343.2 / 350.0 + ring.range_offset[list(ring.paths[k])].mean()) for k, r in echoes]
    lines = extract_lines(ring, dense(ring, reported))
    wanted = extract_lines(plain, dense(plain, echoes))
    np.testing.assert_allclose(lines.rho[0, 0], wanted.rho[0, 0], atol=1e-4)


def test_compiles_once_per_ring(faw_ring, rng):
    """New scans, other numbers of echoes and a recalibrated ring compile nothing."""
    compiled: list[Any] = [kernels.vote, kernels.ring_arcs]
    for kernel in compiled:
        kernel.clear_cache()
    moved = dataclasses.replace(faw_ring, position=faw_ring.position * 1.01, max_range=2.1, name="moved")
    for k in range(4):
        ring = moved if k == 3 else faw_ring
        extract_lines(ring, dense(ring, a_scan(ring, rng, false=k * 3)))
    assert [kernel._cache_size() for kernel in compiled] == [1, 1]


def primitives(jaxpr):
    """Names of all operations of a program and of its inner programs."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for value in jax.tree.leaves(equation.params, is_leaf=lambda leaf: hasattr(leaf, "jaxpr")):
            if hasattr(value, "jaxpr"):
                yield from primitives(value.jaxpr)


def test_one_compiled_call_from_echoes_to_cells(faw_ring):
    """Votes, low pass and threshold are one program without host calls."""
    echoes = kernels.PackedEchoes(jnp.zeros((2, 64), jnp.int32), jnp.full((2, 64), jnp.nan, jnp.float32))
    step = partial(kernels.vote, settings=HoughSettings())
    program = jax.make_jaxpr(step)(arc_tables(faw_ring, HoughSettings()).arcs, echoes)
    came = [(out.shape, str(out.dtype)) for out in program.out_avals]
    assert came == [((2, 100, 100), "bool"), ((2, 64, 64), "int32"), ((2, 64, 64), "float32")]
    inside = set(primitives(program.jaxpr))
    assert {"sqrt", "gt"} <= inside
    assert any("scatter" in name for name in inside)
    assert not any("callback" in name or name == "infeed" for name in inside)


@pytest.mark.parametrize(("offset", "speed"), [(0.25, 343.2), (-0.1, 343.2), (0.0, 319.0), (0.1, 360.0)])
def test_the_maximum_range_applies_to_corrected_ranges(offset, speed):
    """Echoes just within the maximum range vote and others do not, for any range offset and speed of sound."""
    ring = dataclasses.replace(Ring.circular(), range_offset=offset, speed_of_sound=speed)
    for rho, heard in [(2.2, True), (2.5, False)]:
        near = oracles.echoes_of_wall(Ring.circular(max_range=3.0), rho, 0.4)
        near = [(k, r) for k, r in near if (r < 2.0) == heard]
        reported = [(k, r * 343.2 / speed + offset) for k, r in near]
        model = next(local_models(ring, as_log(ring, [reported])))
        assert len(near) >= 10
        assert bool(model.lines) == heard, (rho, model.empty)
        assert heard or model.empty == "no echo within the maximum range"


def test_ranges_beyond_single_precision_are_ignored(faw_ring):
    echoes = [*oracles.echoes_of_wall(faw_ring, 1.2, 0.3), (3, 1e39)]
    assert len(next(local_models(faw_ring, as_log(faw_ring, [echoes]))).lines) == 1


@pytest.mark.slow
def test_large_accumulators_use_smaller_batches(faw_ring):
    fine = HoughSettings(theta_cells=720, rho_cells=300, rho_cell=0.01)
    ranges = np.concatenate([dense(faw_ring, oracles.echoes_of_wall(faw_ring, 1.2, 0.3))] * 40)
    lines = extract_lines(faw_ring, ranges, settings=fine)
    assert (lines.rho[:, 0] == lines.rho[0, 0]).all()
    assert lines.rho[0, 0] == pytest.approx(1.2, abs=0.03)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        (np.zeros((2, 100, 1), np.float32), r"shape \(2, 100, 1\) came; allowed is \(scans, 168, echoes\)"),
        (np.full((1, 168, 1), -0.5, np.float32), r"ranges\[0, 0, 0\] = -0.5"),
    ],
)
def test_invalid_ranges_raise_an_error(faw_ring, ranges, message):
    with pytest.raises(SonarError, match=message):
        extract_lines(faw_ring, ranges)


def test_invalid_arguments_raise_an_error(faw_ring):
    ranges = dense(faw_ring, [])
    with pytest.raises(SonarError, match=r"method 'best'; allowed is ml or hough$"):
        extract_lines(faw_ring, ranges, method="best")
    with pytest.raises(SonarError, match=r"rho_cells 20 x rho_cell 0\.04"):
        extract_lines(faw_ring, ranges, settings=HoughSettings(rho_cells=20))
    stranger = Log.from_echoes(
        np.array([0]), np.array([3]), np.array([24]), np.array([1.0]), stamp=np.zeros(1), pose=np.zeros((1, 3))
    )
    with pytest.raises(SonarError, match="tx 3, rx 24; allowed are 0 to 23"):
        list(local_models(faw_ring, stranger))


def test_pairs_that_are_no_paths_are_counted(faw_ring):
    log = Log.from_echoes(
        np.array([0, 0]), np.array([3, 3]), np.array([3, 12]), np.ones(2), stamp=np.zeros(1), pose=np.zeros((1, 3))
    )
    told = []
    list(local_models(faw_ring, log, on_left_out=told.append))
    assert told == [1]


def test_a_ring_with_a_long_range_gets_a_larger_accumulator():
    ring = Ring.circular(max_range=6.0)
    echoes = oracles.echoes_of_wall(ring, 5.5, 1.0)
    assert extract_lines(ring, dense(ring, echoes)).rho[0, 0] == pytest.approx(5.5, abs=0.03)
