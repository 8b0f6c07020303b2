"""Files for Nav2's map_server, read back by its own rules (nav2_map_server, map_io.cpp)."""

import ast

import cv2
import numpy as np
import pytest

from jaxsonar import Ring, simulate
from jaxsonar.floor_plans.room import Room
from jaxsonar.occupancy.incremental_grid import occupancy
from jaxsonar.occupancy.nav2_map import grid_image_filename, save_nav2

RING = Ring.circular()
WALLS = np.array([[[-2.0, 1.2], [2.0, 1.2]], [[-2.0, -1.1], [2.0, -1.1]], [[2.0, -1.1], [2.0, 1.2]]])


@pytest.fixture(scope="module")
def grid():
    poses = np.stack([np.linspace(-1.5, 1.0, 12), np.zeros(12), np.zeros(12)], axis=-1)
    room = Room(WALLS, (), np.array([[0.4, 0.7]]))
    log = simulate(RING, room, poses, sigma=0.003, seed=1).as_log(RING, poses)
    return occupancy(RING, log, walls=WALLS[:1])


def read_as_map_server(filename):
    """Occupancy (rows from the lowest y, columns): -1 unknown, 0 to 100; and resolution and origin."""
    header = dict(line.split(": ", 1) for line in filename.read_text().splitlines())
    image = cv2.imread(str(filename.parent / ast.literal_eval(header["image"])), cv2.IMREAD_UNCHANGED)
    assert image is not None
    grey, opaque = image, np.ones(image.shape[:2], bool)
    if image.ndim == 3:
        grey = image[..., :3].mean(axis=-1)
        opaque = image[..., 3] == 255 if image.shape[2] == 4 else opaque
    shade = grey / 255
    occupied = shade if header["negate"] == "1" else 1 - shade
    high, low = float(header["occupied_thresh"]), float(header["free_thresh"])
    if header["mode"] == "trinary":
        between = np.full(occupied.shape, -1.0)
    else:
        assert header["mode"] == "scale"
        between = np.rint((occupied - low) / (high - low) * 100)
    cells = np.where(occupied > high, 100, np.where(occupied < low, 0, between))
    if header["mode"] == "scale":
        cells = np.where(opaque, cells, -1)
    return cells[::-1].astype(int), float(header["resolution"]), ast.literal_eval(header["origin"])


@pytest.mark.parametrize("mode", ["trinary", "scale"])
def test_map_server_reads_what_the_grid_holds(grid, tmp_path, mode):
    save_nav2(grid, tmp_path / "map.yaml", mode=mode)
    cells, resolution, origin = read_as_map_server(tmp_path / "map.yaml")
    assert cells.shape == grid.free.shape
    assert (resolution, origin[2]) == (grid.resolution, 0.0)
    np.testing.assert_allclose(origin[:2], grid.origin)
    np.testing.assert_array_equal(cells == 100, grid.occupied)
    np.testing.assert_array_equal(cells == 0, grid.free)
    undecided = ~grid.occupied & ~grid.free
    if mode == "trinary":
        assert (cells[undecided] == -1).all()
        return
    np.testing.assert_array_equal(cells == -1, np.isnan(grid.probability))
    observed = undecided & ~np.isnan(grid.probability)
    assert observed.any()
    expected = 100 * (grid.probability[observed] - 0.196) / (0.65 - 0.196)
    assert np.abs(cells[observed] - expected).max() <= 1


def test_the_probability_follows_the_evidence(grid):
    """Between two undecided cells with equal looks, the one that explains more echoes is the more probable."""
    undecided = ~grid.occupied & ~grid.free & ~np.isnan(grid.probability)
    quiet, heard = undecided & (grid.evidence < 0.01), undecided & (grid.evidence > 0.5)
    assert quiet.any()
    assert heard.any()
    assert grid.probability[heard].mean() > grid.probability[quiet].mean()
    assert (grid.probability[grid.occupied] > 0.65).all()
    assert (grid.probability[grid.free] < 0.196).all()


def test_the_image_of_scale_mode_is_a_png():
    assert grid_image_filename("a/map.YAML", mode="scale").name == "map.png"
    assert grid_image_filename("a/map.yaml").name == "map.pgm"
