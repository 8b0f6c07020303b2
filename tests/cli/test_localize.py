"""Command localize in maps of Nav2's map_server: a round trip through a grid, and errors in one line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.commands import call
from support.grids import rasterized, save_map_server
from support.slam_scene import ROOM, log, truth

from jaxsonar import save_log
from jaxsonar.estimation.trajectory import load_trajectory
from jaxsonar.geometry.se2 import compose, wrap_angle

COUNT = 16
FILES = ("--ring", "faw", "--map", "map.yaml", "--trajectory", "where.tum")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A log with odometry in a frame of its own, and a laser map of its room whose grid is rotated."""
    some = log()[:COUNT]
    save_log(replace(some, pose=compose(np.array([2.0, -1.0, 0.5]), some.pose)), tmp_path / "log.csv")
    origin = np.array([1.0, -2.5, 0.35])
    occupied, free = rasterized(ROOM.walls, 0.05, origin, noise=0.01, gaps=0.2)
    save_map_server(tmp_path, occupied, free, 0.05, origin)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_pose_is_found_in_a_laser_map(here, capsys):
    assert call("localize", "log.csv", *FILES, "--figure", "where.svg") == 0
    found = load_trajectory(here / "where.tum").poses
    apart = found - truth()[:COUNT]
    assert np.median(np.hypot(apart[:, 0], apart[:, 1])) < 0.05
    assert np.median(np.abs(wrap_angle(apart[:, 2]))) < np.radians(2)
    said = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert "the first is at" in said[-1]
    assert "probability" in said[-1]
    assert (here / "where.svg").exists()


RULES = b"negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("map.posegraph", b"\0\1", "map_saver_cli"),
        ("map.pgm", b"P5 1 1 255\n\0", "YAML"),
        ("other.yaml", b"image: none.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n" + RULES, "none.pgm"),
        ("other.yaml", b"image: map.pgm\norigin: [0, 0, 0]\n" + RULES, "resolution"),
        ("free.yaml", b"image: free.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n" + RULES, "free.yaml: no occupied cell"),
        ("dots.yaml", b"image: dots.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n" + RULES, "dots.yaml: no wall"),
        ("list.yaml", json.dumps({"type": "FeatureCollection"}).encode(), "list.yaml"),
        ("gone.yaml", None, "gone.yaml"),
    ],
)
def test_a_map_that_cannot_be_used_is_rejected_in_one_line(here, capsys, name, content, says):
    (here / "free.pgm").write_bytes(b"P5 3 2 255\n" + b"\xfe" * 6)
    (here / "dots.pgm").write_bytes(b"P5 9 1 255\n" + b"\xfe\xfe\xfe\xfe\0\xfe\xfe\xfe\xfe")
    if content is not None:
        (here / name).write_bytes(content)
    assert call("localize", "log.csv", "--ring", "faw", "--map", name, "--trajectory", "where.tum") == 2
    said = [line for line in capsys.readouterr().err.splitlines() if line.strip()]
    assert len(said) == 1, said
    assert says in said[0]
    assert not (here / "where.tum").exists()


def test_no_output_replaces_the_image_of_the_map(here, capsys):
    before = (here / "map.pgm").read_bytes()
    assert call("localize", "log.csv", "--ring", "faw", "--map", "map.yaml", "--trajectory", "map.pgm") == 2
    assert "map.pgm" in capsys.readouterr().err
    assert (here / "map.pgm").read_bytes() == before
