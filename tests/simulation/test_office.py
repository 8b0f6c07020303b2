"""The embedded office has the documented geometry, and the demo writes the documented files."""

import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
import shapely
from support import oracles

from jaxsonar import LocalModel, Ring, load_log, load_ring, load_room, local_models, simulate
from jaxsonar.cli import app as cli
from jaxsonar.demo import run_demo as demo
from jaxsonar.detection.settings_toml import load_settings
from jaxsonar.evaluation.line_accuracy import line_accuracy
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.evaluation.settings import SETTINGS
from jaxsonar.fileio.atomic_files import make_folder
from jaxsonar.mapping.map_geojson import load_map
from jaxsonar.simulation.office import load_office

SIGMA = 0.003
SEEDS = range(10)
CHAIR = "chair back-rest"
PAPER_RHO, PAPER_THETA = 0.0323, math.radians(7.41)
"""The paper's largest deviations over three walls of one scan."""


@pytest.fixture(scope="module")
def noisy(office):
    """The office simulated with several seeds: (simulation, models) of each."""
    found = []
    for seed in SEEDS:
        heard = simulate(office.ring, office.room, office.poses, sigma=SIGMA, seed=seed, stamps=office.stamps)
        found.append((heard, list(local_models(office.ring, heard.as_log(office.ring, office.poses)))))
    return found


def gap(point, wall):
    """Distance of a point from a segment, by sampling points along it."""
    along = np.linspace(0, 1, 20_001)[:, None]
    return np.linalg.norm(wall[0] + along * (wall[1] - wall[0]) - point, axis=-1).min()


def in_frame(pose, point):
    """A world point in the robot frame."""
    x, y = np.asarray(point) - pose[:2]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array([cos * x + sin * y, cos * y - sin * x])


def seen_line(pose, wall):
    """(rho, theta) of a wall's line in the robot frame, from the foot of the perpendicular."""
    start, end = (in_frame(pose, point) for point in wall)
    along = (end - start) / np.linalg.norm(end - start)
    foot = start - (start @ along) * along
    return np.hypot(*foot), math.atan2(foot[1], foot[0])


def is_line(line, rho, theta, *, rho_gate=SETTINGS.lines.gate_rho, theta_gate=SETTINGS.lines.gate_theta):
    return abs(line.rho - rho) <= rho_gate and abs(oracles.wrap(line.theta - theta)) <= theta_gate


def chair_of(office):
    return office.room.walls[office.room.wall_names.index(CHAIR)]


def test_the_ring_is_the_ring_of_the_paper(office):
    assert (office.ring.count, office.ring.neighbors, office.ring.max_range) == (24, 3, 2.0)
    np.testing.assert_allclose(office.ring.position, Ring.circular().position, atol=1e-12)
    assert len(office.ring.paths) == 24 + 144


def test_the_trajectory_has_17_poses_and_the_steps_of_the_paper(office):
    assert office.poses.shape == (17, 3)
    steps = np.hypot(*np.diff(office.poses[:, :2], axis=0).T)
    allowed = np.array([0.25, 0.30, 0.50])
    nearest = allowed[np.abs(steps[:, None] - allowed).argmin(axis=1)]
    np.testing.assert_allclose(steps, nearest, atol=1e-3)
    assert set(nearest) == set(allowed)
    assert (np.diff(office.stamps) > 0).all()
    np.testing.assert_array_equal(office.poses[0], 0)


def test_three_walls_are_in_range_of_the_first_pose(office):
    near = {
        name
        for wall, name in zip(office.room.walls, office.room.wall_names, strict=True)
        if name != CHAIR and gap(office.poses[0, :2], wall) < 2.0
    }
    assert near == {"left wall", "right wall", "back wall"}


def test_the_chair_is_at_the_position_of_the_paper(office):
    chair = chair_of(office)
    np.testing.assert_allclose(in_frame(office.poses[0], chair.mean(axis=0)), [0.99, -0.63], atol=1e-3)
    assert 0.3 < np.linalg.norm(chair[1] - chair[0]) < 0.6


def test_there_are_recesses_for_a_door_and_a_cupboard(office):
    assert {"door", "cupboard", "door jamb", "cupboard side"} <= set(office.room.wall_names)


def test_all_poses_have_clearance(office):
    for x, y, _ in office.poses:
        assert min(gap(np.array([x, y]), wall) for wall in office.room.walls) > 0.3
        assert all(math.dist((x, y), pole) > 0.3 for pole in office.room.poles)


@pytest.mark.slow
def test_the_robot_crosses_no_wall(office):
    way = np.stack([office.poses[:-1, :2], office.poses[1:, :2]], axis=1)
    along = np.linspace(0, 1, 11)[:, None]
    for start, end in way:
        for point in start + along * (end - start):
            assert min(gap(point, wall) for wall in office.room.walls) > 0.25


def test_the_room_is_closed_and_not_aligned_with_the_ring(office):
    """Outer walls form a closed loop; no wall is perpendicular to a sensor axis at the first pose."""
    outer = [wall for wall, name in zip(office.room.walls, office.room.wall_names, strict=True) if name != CHAIR]
    ends = [tuple(end) for wall in outer for end in wall.tolist()]
    assert all(ends.count(end) == 2 for end in ends)
    for wall in outer:
        turn = math.degrees(seen_line(office.poses[0], wall)[1]) % 15
        assert min(turn, 15 - turn) > 1


def test_the_chair_is_detected_at_later_poses_only(office, noisy):
    """For every seed: no line at the first pose, and a line at one or more later poses."""
    chair = chair_of(office)
    for _, models in noisy:
        seen = [
            any(is_line(line, *seen_line(pose, chair)) for line in model.lines)
            for model, pose in zip(models, office.poses, strict=True)
        ]
        assert not seen[0]
        assert any(seen[1:])


def test_three_walls_at_the_first_pose_with_deviations_as_in_the_paper(office, noisy):
    """For 8 of 10 seeds exactly the three walls have lines, within the paper's deviations."""
    good = 0
    for _, models in noisy:
        walls = {
            name: seen_line(office.poses[0], wall)
            for wall, name in zip(office.room.walls, office.room.wall_names, strict=True)
            if name != CHAIR and gap(office.poses[0, :2], wall) < 2.0
        }
        hits = [
            [name for name, wall in walls.items() if is_line(line, *wall, rho_gate=PAPER_RHO, theta_gate=PAPER_THETA)]
            for line in models[0].lines
        ]
        good += sorted(hits) == [["back wall"], ["left wall"], ["right wall"]]
    assert good >= 8


def test_most_clearly_visible_walls_are_detected(office, noisy):
    for heard, models in noisy:
        result = line_accuracy(office.ring, models, heard, office.room, office.poses, sigma=SIGMA)
        assert result.walls >= 2 * 17
        assert result.recall >= 0.9
        assert result.false_per_scan <= 2
        assert np.sqrt(np.mean(result.rho_error**2)) < PAPER_RHO
        assert np.sqrt(np.mean(result.theta_error**2)) < PAPER_THETA


def test_segments_of_true_walls_lie_on_them(office, noisy):
    """The middle of each segment of the back wall is near that wall in the world frame."""
    wall = office.room.walls[office.room.wall_names.index("back wall")]
    for _, models in noisy[:3]:
        for model, pose in zip(models[:4], office.poses, strict=False):
            cos, sin = math.cos(pose[2]), math.sin(pose[2])
            for line in model.lines:
                if is_line(line, *seen_line(pose, wall)):
                    middle = line.segment.mean(axis=0) @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]
                    assert gap(middle, wall) < 0.05


# The demo

FIGURES = (
    "1-ring", "2-reference", "3-arcs", "4-lines", "4-accumulator", "5-modeling", "6-segments", "7-map", "8-grid",
)  # fmt: skip
FILES = {
    *(f"{name}.{suffix}" for name in FIGURES for suffix in ("svg", "png")),
    *("office.csv", "path.csv", "office.geojson", "ring.toml", "lines.jsonl", "lines.settings.toml", "table.json"),
    *("map.geojson", "map.yaml", "map.pgm", "map-table.json", "index.html"),
}


@pytest.fixture(scope="module")
def written(short_demo):
    """The folder of a short demo, and its output."""
    folder, tables, said = short_demo
    return folder / "demo", tables, said


@pytest.mark.slow
def test_the_demo_writes_all_documented_files(written):
    folder, _, said = written
    assert {path.name for path in folder.iterdir()} == FILES
    assert all(path.stat().st_size > 100 for path in folder.iterdir())
    assert any("17 scans" in step for step in said)
    assert any("10 random poses in 2 random rooms" in step for step in said)


@pytest.mark.slow
def test_the_table_contains_finite_numbers(written):
    def refuse(constant):
        raise ValueError(f"{constant} is no JSON")

    folder, (rows, _), _ = written
    table = json.loads((folder / "table.json").read_text(), parse_constant=refuse)
    assert [row["what"] for row in table] == [name for name, _ in rows]
    assert [row["scans"] for row in table] == [1, 1, 17, 17, 17, 10, 10, 10]
    for row, (_, result) in zip(table, rows, strict=True):
        for key, value in row.items():
            if key == "what":
                continue
            missing = not len(result.rho_error) or not np.isfinite(result.rho_bound).any()
            assert missing or (isinstance(value, int | float) and math.isfinite(value)), key
        assert 0 <= row["recall"] <= 1
        assert row["walls"] > 0
        assert row["lines"] >= row["false_per_scan"] * row["scans"]
        assert len(result.rho_error) == result.lines - result.false
        if len(result.rho_error):
            assert row["rho_max_mm"] >= row["rho_rms_mm"]
            assert row["theta_max_deg"] == pytest.approx(np.degrees(np.abs(result.theta_error)).max())
    first = table[0]
    assert (first["walls"], first["recall"]) == (3, 1.0)
    # Both methods and both rings are evaluated on the same walls; the paper's ring detects more of them.
    for full, paper, usual in ((2, 3, 4), (5, 6, 7)):
        assert table[full]["walls"] == table[paper]["walls"] == table[usual]["walls"]
        assert table[full]["recall"] > table[usual]["recall"]
        assert table[full]["echoes_per_scan"] > table[usual]["echoes_per_scan"]
        # Maximum likelihood is more accurate than centers of gravity, and reports fewer corners as walls.
        assert table[full]["rho_rms_mm"] < table[paper]["rho_rms_mm"] / 3
        assert table[full]["theta_rms_deg"] < table[paper]["theta_rms_deg"] / 2
        assert table[full]["false_per_scan"] < table[paper]["false_per_scan"] / 2


@pytest.mark.slow
def test_the_map_has_one_segment_for_every_wall_in_range(written, office):
    """Exactly one segment per wall, chair back-rest included, more accurate than the single segments."""
    folder, (_, maps), _ = written
    assert json.loads((folder / "map-table.json").read_text()) == maps
    of_paper, paper, aggregated, world = maps
    assert (world["false"], world["segments"], world["walls"], world["walls_found"]) == (0, 8, 8, 8)
    assert world["rho_rms_mm"] < aggregated["rho_rms_mm"] < of_paper["rho_rms_mm"] < paper["rho_rms_mm"]
    assert world["theta_rms_deg"] < aggregated["theta_rms_deg"] < of_paper["theta_rms_deg"]
    segments = load_map(folder / "map.geojson").segments
    chair = shapely.LineString(office.room.walls[office.room.wall_names.index(CHAIR)])
    assert any(shapely.LineString(segment).hausdorff_distance(chair) < 0.1 for segment in segments)


@pytest.mark.slow
def test_the_commands_reproduce_the_map_of_the_demo(written, tmp_path, capsys):
    folder, _, _ = written
    again = tmp_path / "again.geojson"
    call = ["map", str(folder / "office.csv"), "--ring", str(folder / "ring.toml"), "-o", str(again)]
    assert cli.main([*call, "--grid", str(tmp_path / "map.yaml")]) == 0
    for mine, name in ((again, "map.geojson"), (tmp_path / "map.pgm", "map.pgm"), (tmp_path / "map.yaml", "map.yaml")):
        assert mine.read_bytes() == (folder / name).read_bytes()
    capsys.readouterr()


def test_a_missing_output_folder_is_created(tmp_path):
    make_folder(tmp_path / "new" / "folder")
    assert (tmp_path / "new" / "folder").is_dir()


@pytest.mark.slow
def test_the_page_contains_all_figures(written):
    folder, _, _ = written
    page = (folder / "index.html").read_text()
    assert page.count("<img") == len(FIGURES)
    assert page.count("<table") == 2
    assert "http" not in page.replace("http-equiv", "")


@pytest.mark.slow
def test_the_commands_reproduce_the_lines_of_the_demo(written, tmp_path, capsys):
    folder, _, _ = written
    again = tmp_path / "again.jsonl"
    assert cli.main(["lines", str(folder / "office.csv"), "--ring", str(folder / "ring.toml"), "-o", str(again)]) == 0
    assert again.read_bytes() == (folder / "lines.jsonl").read_bytes()
    beside = tmp_path / "again.settings.toml"
    assert beside.read_bytes() == (folder / "lines.settings.toml").read_bytes()
    capsys.readouterr()


@pytest.mark.slow
def test_the_commands_reproduce_the_log_of_the_demo(written, tmp_path, office, capsys):
    folder, _, _ = written
    path = tmp_path / "path.csv"
    poses = np.column_stack([office.stamps, office.poses]).tolist()
    path.write_text("\n".join(["stamp,x,y,theta", *(",".join(map(repr, row)) for row in poses)]))
    room, ring = str(folder / "office.geojson"), str(folder / "ring.toml")
    call = ["simulate", room, "--ring", ring, "--path", str(path), "--sigma", str(demo.SETTINGS.sigma), "--seed", "1"]
    assert cli.main([*call, "-o", str(tmp_path / "again.csv")]) == 0
    assert load_log(tmp_path / "again.csv") == load_log(folder / "office.csv")
    capsys.readouterr()


@pytest.mark.slow
def test_the_files_of_the_demo_can_be_loaded(written, office):
    folder, _, _ = written
    assert len(load_log(folder / "office.csv")) == 17
    np.testing.assert_array_equal(load_room(folder / "office.geojson").walls, office.room.walls)
    ring = load_ring(folder / "ring.toml")
    np.testing.assert_allclose(ring.position, office.ring.position, atol=1e-12)
    assert ring.name == office.ring.name
    assert load_settings(folder / "lines.settings.toml").rho_cells == 100
    assert tomllib.loads((folder / "ring.toml").read_text())["ring"]["count"] == 24


def test_the_conventional_ring_receives_direct_echoes_only(office):
    usual = demo.conventional_ring(office.ring)
    assert (usual.paths[:, 0] == usual.paths[:, 1]).all()
    np.testing.assert_allclose(np.degrees(usual.beam), 30)
    np.testing.assert_array_equal(usual.position, office.ring.position)
    assert usual.max_range == office.ring.max_range


def test_the_demo_command_prints_the_table(tmp_path, capsys, monkeypatch):
    """With a stub for the computation: tables on standard output, everything else on standard error."""
    rows = []
    some = np.array([[[0.0, 0.0], [1.0, 0.0]]])
    nothing = demo.map_summary(evaluate(np.zeros((0, 2, 2)), some), np.ones(1, dtype=bool), sigma=SIGMA)

    def quick(output, *, seed, on_step, on_room):
        on_step(f"seed {seed}")
        return rows, [{"what": "no map at all", **nothing}]

    empty = load_office()
    heard = simulate(empty.ring, empty.room, empty.poses[:1], sigma=SIGMA)
    rows.append(
        (
            "no line at all",
            line_accuracy(empty.ring, [LocalModel(0, 0.0, ())], heard, empty.room, empty.poses[:1], sigma=SIGMA),
        )
    )
    monkeypatch.setattr(demo, "run_demo", quick)
    assert cli.main(["demo", "-o", str(tmp_path / "d"), "--seed", "7"]) == 0
    came = capsys.readouterr()
    assert "no line at all" in came.out
    assert "no map at all" in came.out
    assert "32.3" in came.out
    assert "7.41" in came.out
    assert "nan" not in came.out
    assert "seed 7" in came.err
    assert not Path(tmp_path / "d").exists()
