"""Commands slam, localize and stream --slam: files are as documented, errors are printed in one line."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from support.commands import call
from support.slam_scene import ODOMETRY_NOISE, RING, ROOM, log, truth

from jaxsonar import load_log, save_log
from jaxsonar.estimation.trajectory import Trajectory, load_trajectory, save_trajectory, stamps_of
from jaxsonar.mapping.build_map import build_map
from jaxsonar.mapping.map_geojson import load_map, save_map
from jaxsonar.occupancy.incremental_grid import occupancy
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.nav2_map import save_nav2

ODOMETRY = f"{100 * ODOMETRY_NOISE.position_per_meter:g},{np.degrees(ODOMETRY_NOISE.heading_per_meter):g}"
COUNT = 14


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A log with odometry, the truth, a map from the true poses, and the outputs of the command."""
    folder = tmp_path_factory.mktemp("slam")
    some = log()[:COUNT]
    save_log(some, folder / "log.csv")
    save_trajectory(Trajectory(stamps_of(some), truth()[:COUNT]), folder / "truth.tum")
    save_map(build_map(RING, replace(log(seed=2), pose=truth())), folder / "known.geojson")
    files = "-o map.geojson --trajectory poses.tum --figure run.svg --json run.json --truth truth.tum"
    files += " --log corrected.csv --grid grid.yaml"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert call("slam", "log.csv", "--ring", "faw", *files.split(), "--odometry", ODOMETRY) == 0
    return folder


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_slam_writes_all_requested_files(here):
    poses, given = load_trajectory(here / "poses.tum"), load_trajectory(here / "truth.tum")
    assert len(poses) == COUNT
    np.testing.assert_allclose(poses.poses[0], load_log(here / "log.csv").pose[0], atol=0.02)
    world = load_map(here / "map.geojson")
    assert len(world) >= 3
    assert (here / "run.svg").read_text().lstrip().startswith("<?xml")
    said = json.loads((here / "run.json").read_text())
    assert said["scans"] == COUNT
    assert said["left_out"] == []
    assert 0.001 < said["sigma"] < 0.003
    assert said["errors"]["estimate"]["poses"] == COUNT
    assert said["errors"]["estimate"]["ate"] < said["errors"]["odometry"]["ate"]
    assert said["closures"] == []
    assert len(given) == COUNT


@pytest.mark.slow
def test_the_corrected_log_has_the_estimated_poses_and_gives_the_grid(here):
    corrected, given = load_log(here / "corrected.csv"), load_log(here / "log.csv")
    np.testing.assert_allclose(corrected.pose, load_trajectory(here / "poses.tum").poses, atol=1e-8)
    assert replace(corrected, pose=given.pose) == given
    known = KnownReflectors.of_map(load_map(here / "map.geojson"))
    save_nav2(occupancy(RING, corrected, walls=known), here / "again.yaml")
    cells = [(here / name).read_bytes().split(b"\n", 3) for name in ("again.pgm", "grid.pgm")]
    assert cells[0][:3] == cells[1][:3]
    again, first = (np.frombuffer(cell[3], np.uint8) for cell in cells)
    assert np.mean(again != first) < 0.01  # the map of the file has rounded numbers
    assert {0, 205, 254} == set(first.tolist())


@pytest.mark.slow
def test_errors_are_printed_and_the_trajectory_may_go_to_standard_output(here, capsys):
    arguments = ("--odometry", ODOMETRY, "--no-smoothing", "--truth", "truth.tum", "--trajectory", "-")
    assert call("slam", "log.csv", "--ring", "faw", "-o", "again.geojson", *arguments) == 0
    out, said = capsys.readouterr()
    assert len([line for line in out.splitlines() if not line.startswith("#")]) == COUNT
    assert f"{COUNT} scans, {COUNT} of them with a pose" in said
    assert "error, first pose on the truth: " in said
    assert "error, best alignment: " in said
    assert "error of the odometry, first pose on the truth: " in said
    assert "mm" in said


BAD = {
    "slam no.csv --ring faw -o out.geojson": "no.csv",
    "slam log.csv --ring faw -o log.csv": "log.csv",
    "slam log.csv --ring faw -o out.geojson --trajectory out.geojson": "out.geojson",
    "slam log.csv --ring faw -o out.geojson --sigma -1": "--sigma",
    "slam log.csv --ring faw -o out.geojson --odometry 3": "--odometry",
    "slam log.csv --ring faw -o - --trajectory -": "standard output",
    "slam log.csv --ring faw -o out.geojson --scale --no-smoothing": "estimated by smoothing",
    "slam log.csv --ring faw -o out.geojson --truth other.tum": "--truth",
    "slam log.csv --ring faw -o out.geojson --figure run.xyz": "--figure",
    "slam log.csv --ring faw": "-o",
    "slam log.csv --ring faw -o out.geojson --log log.csv": "log.csv",
    "slam log.csv --ring faw -o out.geojson --log out.txt": "--log",
    "slam log.csv --ring faw -o out.geojson --grid-mode scale": "--grid-mode came without --grid",
    "slam log.csv --ring faw -o out.geojson --grid out.png": "--grid",
    "map log.csv --ring faw -o out.geojson --grid-method em": "--grid-method came without --grid",
    "map log.csv --ring faw -o out.geojson --grid out.yaml --grid-method votes": "--grid-method",
    "map log.csv --ring faw -o out.geojson --grid out.yaml --grid-mode scale --figure out.png": "out.png",
    "slam nowhere.csv --ring faw -o out.geojson --window 1": "odometry",
    "localize log.csv --ring faw --map no.geojson --trajectory out.tum": "no.geojson",
    "localize log.csv --ring faw --map known.geojson --trajectory known.geojson": "known.geojson",
    "localize log.csv --ring faw --map known.geojson --trajectory out.tum --start 1,2": "X,Y,DEG",
    "localize log.csv --ring faw --map known.geojson --trajectory out.tum --start 1,2,nan": "X,Y,DEG",
    "localize log.csv --ring faw --map empty.geojson --trajectory out.tum": "empty.geojson: no wall",
    "localize log.csv --ring faw --trajectory out.tum": "--map",
    "stream file:log.csv --ring faw --trajectory out.tum": "--slam",
}


@pytest.mark.slow
@pytest.mark.parametrize("line", BAD)
def test_an_invalid_call_is_answered_in_one_line(here, capsys, line):
    save_trajectory(Trajectory(np.array([1e6]), np.zeros((1, 3))), here / "other.tum")
    text = (here / "log.csv").read_text().splitlines()
    header = text[0].split(",")
    rows = [dict(zip(header, row.split(","), strict=True)) | dict.fromkeys(("x", "y", "theta"), "") for row in text[1:]]
    (here / "nowhere.csv").write_text("\n".join([text[0], *(",".join(row.values()) for row in rows)]) + "\n")
    (here / "empty.geojson").write_text('{"type": "FeatureCollection", "features": []}')
    before = {path.name: path.read_bytes() for path in here.iterdir()}
    assert call(*line.split()) == 2
    said = capsys.readouterr().err
    last = [part for part in said.splitlines() if part.strip()]
    assert len(last) == 1, said
    assert BAD[line] in last[0]
    assert {path.name: path.read_bytes() for path in here.iterdir()} == before


@pytest.mark.slow
def test_localize_in_a_map(here, capsys):
    """Without a start pose, and with an approximate one."""
    pose = truth()[0]
    start = f"--start={pose[0] + 0.2:.2f},{pose[1] - 0.1:.2f},{np.degrees(pose[2]) + 5:.1f}"
    for more in ((), (start, "--figure", "where.svg")):
        files = ("--map", "known.geojson", "--trajectory", "where.tum")
        assert call("localize", "log.csv", "--ring", "faw", *files, *more) == 0
        found = load_trajectory(here / "where.tum")
        np.testing.assert_allclose(found.poses, truth()[:COUNT], atol=0.06)  # some scans see no perpendicular wall
        assert "the first is at" in capsys.readouterr().err
    assert (here / "where.svg").exists()


@pytest.mark.slow
def test_localize_in_a_floor_plan_with_a_negative_start(here, capsys):
    from jaxsonar.floor_plans.room_geojson import save_room

    save_room(ROOM, here / "plan.geojson")
    x, y, theta = truth()[0]
    near = f"{x - 0.2:.2f},{y:.2f},{np.degrees(theta):.1f}"
    arguments = ("localize", "log.csv", "--ring", "faw", "--map", "plan.geojson", "--trajectory")
    assert call(*arguments, "p.tum", "--start", near) == 0
    # A file does not tell that paths without any echo were measured, so their silence does not help.
    np.testing.assert_allclose(load_trajectory(here / "p.tum").poses, truth()[:COUNT], atol=0.08)
    # A start far below the origin is parsed; there is no map.
    assert call(*arguments, "q.tum", "--start", "-9,-9,0") == 1
    assert "no place" in capsys.readouterr().err
    assert not (here / "q.tum").exists()


@pytest.mark.slow
def test_truth_needs_ascending_stamps(here, capsys):
    falling = load_log(here / "log.csv")
    save_log(replace(falling, stamp=falling.stamp[::-1].copy()), here / "falling.csv")
    assert call("slam", "falling.csv", "--ring", "faw", "-o", "out.geojson", "--truth", "truth.tum") == 2
    assert "do not rise" in capsys.readouterr().err
    assert not (here / "out.geojson").exists()


@pytest.mark.slow
def test_localize_reports_an_uncertain_pose(here, capsys):
    """A rectangle is symmetric under half a turn: exit code 1, both poses, no file."""
    from support.hard_cones import simulate

    from jaxsonar import Room

    corners = np.array([[0, 0], [3, 0], [3, 2], [0, 2]], dtype=float)
    room = Room(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1))
    poses = np.array([[0.8 + 0.12 * k, 0.7 + 0.03 * k, 0.2 + 0.05 * k] for k in range(5)])
    given = simulate(RING, room, poses, sigma=0.001, seed=2).as_log(RING, poses)
    save_log(given, here / "alike.csv")
    # The map contains both ends of the room.
    both = np.concatenate([poses, np.array([3.0, 2.0, 0.0]) - poses * [1, 1, -1] + [0, 0, np.pi]])
    known = simulate(RING, room, both, sigma=0.001, seed=3).as_log(RING, both)
    save_map(build_map(RING, known), here / "alike.geojson")
    files = ("--map", "alike.geojson", "--trajectory", "where.tum")
    assert call("localize", "alike.csv", "--ring", "faw", *files) == 1
    said = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(said) == 3
    assert "ambiguous, 2 places look alike" in said[0]
    chance = [float(line.split(" %")[0]) for line in said[1:]]
    assert 40 < chance[1] <= chance[0] < 60
    assert not (here / "where.tum").exists()


@pytest.mark.slow
def test_stream_estimates_poses(here):
    """The device's poses are odometry; the trajectory is written at the end."""
    options = ("--slam", "--odometry", ODOMETRY, "--trajectory", "live.tum", "--map", "live.geojson")
    assert call("stream", "file:log.csv", "--ring", "faw", *options) == 0
    found = load_trajectory(here / "live.tum")
    assert len(found) == COUNT
    first = load_log(here / "log.csv").pose[0]
    np.testing.assert_allclose(found.poses[0], first, atol=1e-6)
    assert len(ROOM.walls) >= len(load_map(here / "live.geojson")) >= 3
