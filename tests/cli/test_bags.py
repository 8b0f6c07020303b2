"""Commands on ROS bags of each kind: a turning robot whose sensors fire in turn gives the result of one at rest."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.bags import KINDS, firing_log, sonar_ring, spinning
from support.commands import call, contents
from support.input_files import WALLS, spinning_bag

from jaxsonar import Room, load_log, load_ring, save_log, save_ring
from jaxsonar.mapping.map_geojson import load_map
from jaxsonar.scans.single_firings import group_firings

pytest.importorskip("rosbags")

SECONDS = 8.0
PERIOD, SENSORS = 0.025, 16
RATE = np.radians(40)
CENTER = (1.7, 1.3)


def errors_of_walls(filename):
    """Distance (m) and turn (rad) of each wall of the room in a map, which holds no other wall."""
    world = load_map(filename)
    assert len(world) == len(WALLS)
    errors = []
    for start, end in WALLS:
        across = np.array([start[1] - end[1], end[0] - start[0]]) / np.linalg.norm(end - start)
        normal = np.column_stack([np.cos(world.theta), np.sin(world.theta)])
        sign = np.where(normal @ across < 0, -1.0, 1.0)
        distance = sign * (normal @ ((start + end) / 2) - world.rho)
        turn = np.arcsin(np.clip(sign * (normal[:, 1] * across[0] - normal[:, 0] * across[1]), -1, 1))
        near = np.flatnonzero((np.abs(distance) < 0.1) & (np.abs(turn) < np.radians(6)))
        assert len(near) == 1, (distance, turn)
        errors.append((distance[near[0]], turn[near[0]]))
    return np.array(errors)


def mapped(log, ring, output, capsys, command="map"):
    """Errors of the walls, and what the command prints."""
    assert call(command, log, "--ring", ring, "-o", output) == 0
    return errors_of_walls(output), capsys.readouterr().err


def findings(log, ring, output, capsys):
    assert call("check", log, "--ring", ring, "--json", output) == 0
    capsys.readouterr()
    return json.loads(output.read_text())["findings"]


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory):
    """The log and the ring of the same robot that stands still in each scan, at the poses of the turning one."""
    folder, ring = tmp_path_factory.mktemp("rest"), sonar_ring(SENSORS)
    turn = spinning(CENTER, RATE)
    scan = PERIOD * SENSORS
    times = np.arange(0.0, SECONDS, PERIOD)
    each = firing_log(ring, Room(WALLS), lambda time: turn(np.floor(time / scan + 1e-6) * scan), times)
    log = group_firings(each)
    assert np.ptp(each.pose[:SENSORS], axis=0).max() == 0
    save_log(replace(log, t=np.zeros(len(log.t)), odometry=None), folder / "rest.csv")
    save_ring(ring, folder / "ring.toml")
    return folder / "rest.csv", folder / "ring.toml"


def test_convert_writes_the_readings_of_a_turning_robot(tmp_path, capsys, at_rest):
    """As many scans at the same poses; the firings of a scan have times, and the ranges fit to these."""
    bag, _ = spinning_bag(tmp_path / "run", "sqlite", seconds=2.0)
    assert call("convert", bag, tmp_path / "run.csv") == 0
    err = capsys.readouterr().err
    assert "/odom" in err
    log, rest = load_log(tmp_path / "run.csv"), load_log(at_rest[0])[:5]
    assert err.splitlines()[-1].startswith(f"{len(log)} scans, {log.echo_count} echoes")
    assert len(log) == len(rest)
    np.testing.assert_allclose(log.pose, rest.pose, atol=1e-6)
    np.testing.assert_allclose(log.t, PERIOD * np.tile(np.arange(SENSORS), len(log)), atol=1e-6)
    np.testing.assert_array_equal(log.tx, rest.tx)


@pytest.mark.slow
def test_every_command_reads_bags(tmp_path, capsys, at_rest):
    """convert, map, slam and check give the result of the converted log, and that of the same run at rest."""
    bag, ring = spinning_bag(tmp_path / "run", "sqlite", seconds=SECONDS)
    csv = tmp_path / "run.csv"
    assert call("convert", bag, csv) == 0
    assert load_log(csv) == load_log(bag)
    capsys.readouterr()
    errors = {}
    for name, log in (("bag", bag), ("csv", csv), ("rest", at_rest[0])):
        errors[name], err = mapped(log, ring, tmp_path / f"{name}.geojson", capsys)
        assert "20 scans" in err.splitlines()[-1]
        assert findings(log, ring, tmp_path / f"{name}.json", capsys) == []
        errors[f"{name} by slam"], _ = mapped(log, ring, tmp_path / f"{name}-slam.geojson", capsys, "slam")
    for name in ("csv", "rest"):
        for how in ("", " by slam"):
            np.testing.assert_allclose(errors[name + how], errors["bag" + how], atol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "sqlite"])
def test_bags_of_each_kind_hold_the_same_log(tmp_path, kind, capsys):
    """Commands load all logs by one function: a bag with an equal log gives an equal map."""
    bag, ring = spinning_bag(tmp_path / "run", kind, seconds=SECONDS)
    other, _ = spinning_bag(tmp_path / "sqlite", "sqlite", seconds=SECONDS)
    csv = tmp_path / "run.csv"
    assert call("convert", bag, csv) == 0
    assert load_log(csv) == load_log(bag) == load_log(other)
    capsys.readouterr()
    _, err = mapped(bag, ring, tmp_path / "map.geojson", capsys)
    assert "20 scans" in err.splitlines()[-1]
    assert findings(bag, ring, tmp_path / "check.json", capsys) == []


@pytest.mark.parametrize("kind", ["sqlite", *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[::2])])
def test_a_bag_gives_a_ring(tmp_path, capsys, kind):
    """``--ring-out`` writes the ring that the transforms describe; the log fits to it."""
    bag, file = spinning_bag(tmp_path / "run", kind, seconds=1.0, transforms=True)
    assert call("convert", bag, tmp_path / "out.csv", "--ring-out", tmp_path / "out.toml") == 0
    assert "16" in capsys.readouterr().err
    ring, true = load_ring(tmp_path / "out.toml"), load_ring(file)
    assert ring.names == tuple(f"sonar_{k}" for k in range(SENSORS))
    np.testing.assert_allclose(ring.position, true.position, atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * ring.heading), np.exp(1j * np.asarray(true.heading)), atol=1e-6)
    np.testing.assert_allclose(ring.beam, 1.0)
    assert (ring.max_range, ring.neighbors) == (4.0, 0)
    log = load_log(tmp_path / "out.csv", ring=ring)
    assert log == load_log(bag, ring=true)


def test_a_bag_without_transforms_gives_no_ring(tmp_path, capsys):
    """It says which transforms are missing; nothing is written."""
    bag, _ = spinning_bag(tmp_path / "run", "sqlite", seconds=1.0)
    before = contents(tmp_path)
    assert call("convert", bag, tmp_path / "out.csv", "--ring-out", tmp_path / "out.toml") == 2
    assert "no robot frame base_link came" in capsys.readouterr().err.splitlines()[-1]
    assert contents(tmp_path) == before
