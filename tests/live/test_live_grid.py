"""Grids of a stream: those of its log, and files that readers can use at any time."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import support.rooms as rooms
from support.hard_cones import simulate

from jaxsonar import Log, Ring
from jaxsonar.floor_plans.room import Room
from jaxsonar.hardware.errors import SonarError
from jaxsonar.live.grid_files import GridFiles
from jaxsonar.live.live_grid import SETTINGS, LiveGrid
from jaxsonar.live.live_map import LiveMap
from jaxsonar.mapping.map_from_room import map_from_room
from jaxsonar.occupancy.incremental_grid import occupancy
from jaxsonar.occupancy.known_reflectors import KnownReflectors
from jaxsonar.occupancy.nav2_map import grid_image_filename, save_nav2
from jaxsonar.occupancy.occupancy_grid import OccupancyGrid

RING = Ring.circular(count=12, beam=0.7, neighbors=1)
ROOM = Room(rooms.loop([(-1.7, -1.2), (1.6, -1.2), (1.6, 1.3), (-1.7, 1.3)]))
WORLD = map_from_room(ROOM)


@pytest.fixture(scope="module")
def scans():
    at = np.linspace(0, 1, 12)
    poses = np.stack([0.8 * at - 0.4, 0.3 * at, 0.7 * at], axis=-1)
    return list(simulate(RING, ROOM, poses, sigma=0.001, seed=1, stamps=at).as_log(RING, poses))


class LiveMapOfTest(LiveMap):
    """What a grid uses of a ``LiveMap``; the estimated poses can be moved."""

    def __init__(self, *, slam=False, in_range=1):
        super().__init__(RING, method="hough", mapping=False)
        self.slam, self.in_range = slam, in_range
        self.scans, self.offset = [], np.zeros(3)

    def poses(self):
        return np.array([scan.pose for scan in self.scans]) + self.offset

    def scans_at_current_poses(self):
        return [replace(scan, pose=pose) for scan, pose in zip(self.scans, self.poses(), strict=True)]


def add(live, grid, scans):
    """Process scans: the first of them come before the others."""
    live.scans += scans
    grid.add(scans)


def files_of(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def written(scans, filename, *, world=WORLD):
    """The files of the grid of a log."""
    filename.parent.mkdir()
    save_nav2(occupancy(RING, Log.from_scans(scans), walls=KnownReflectors.of_map(world)), filename)
    return files_of(filename.parent)


def test_the_grid_of_a_stream_is_that_of_its_log(scans, tmp_path):
    """In one update exactly; in several with the same walls, too, up to the walls' parts that later scans refute."""
    whole = written(scans, tmp_path / "log" / "m.yaml")
    for number in (1, 3):
        folder = tmp_path / str(number)
        folder.mkdir()
        live = LiveMapOfTest()
        grid = LiveGrid(live, folder / "m.yaml", interval=0.0)
        assert not grid.is_due, "no scan"
        for part in np.array_split(np.arange(len(scans)), number):
            add(live, grid, [scans[k] for k in part])
            grid.start_update(WORLD)
        grid.finish(WORLD)
        found = files_of(folder)
        assert grid.empty == ""
        assert found.keys() == whole.keys() == {"m.yaml", "m.pgm"}
        assert found["m.yaml"] == whole["m.yaml"]
        one, other = (np.frombuffer(files["m.pgm"], np.uint8) for files in (found, whole))
        assert (one != other).mean() <= (0 if number == 1 else 0.01)


def test_a_grid_of_corrected_poses_is_that_of_the_corrected_log(scans, tmp_path):
    """Small corrections are left out; larger ones move everything."""
    live = LiveMapOfTest(slam=True)
    grid = LiveGrid(live, tmp_path / "m.yaml", interval=0.0)
    add(live, grid, scans[:8])
    grid.start_update(WORLD)
    live.offset = np.array([0.5 * SETTINGS.max_position_change, 0.0, 0.0])
    add(live, grid, scans[8:10])
    grid.start_update(WORLD)
    grid.wait()
    assert files_of(tmp_path).keys() > {"m.yaml"}
    live.offset = np.array([0.75, -0.4, 0.0])
    add(live, grid, [replace(scan, pose=scan.pose + live.offset) for scan in scans[10:]])
    for scan in live.scans[10:]:
        scan.pose[:] -= live.offset
    world = map_from_room(Room(ROOM.walls + live.offset[:2]))
    grid.finish(world)
    moved = [replace(scan, pose=scan.pose + live.offset) for scan in scans]
    assert files_of(tmp_path) == written(moved, tmp_path / "log" / "m.yaml", world=world)


@pytest.mark.parametrize(
    ("posed", "in_range", "reason"),
    [(False, 5, "12 scans without a pose came"), (True, 0, "no echo within the maximum range came")],
)
def test_a_grid_without_evidence_is_not_written(posed, in_range, reason, scans, tmp_path):
    live = LiveMapOfTest(in_range=in_range)
    grid = LiveGrid(live, tmp_path / "m.yaml", interval=0.0)
    add(live, grid, scans if posed else [replace(scan, pose=np.full(3, np.nan)) for scan in scans])
    grid.start_update(WORLD)
    grid.finish(WORLD)
    assert reason in grid.empty
    assert not list(tmp_path.iterdir())


def test_updates_pause_and_failures_reach_the_stream(scans, tmp_path):
    live = LiveMapOfTest()
    grid = LiveGrid(live, tmp_path / "no" / "m.yaml", interval=1e3)
    add(live, grid, scans[:1])
    assert not grid.is_due, "the interval is long"
    add(live, grid, scans[1:2] * SETTINGS.max_pending)
    assert grid.is_full, "memory is bounded"
    assert grid.is_due
    grid = LiveGrid(live, tmp_path / "no" / "m.yaml", interval=0.0)
    add(live, grid, scans[:1])
    assert grid.is_due
    grid.start_update(WORLD)
    add(live, grid, scans[1:2])
    with pytest.raises(SonarError, match="allowed is a file in an existing folder"):
        grid.start_update(WORLD)


def small_grid(corner, columns, value):
    """A grid whose image tells where its origin is."""
    occupied = np.zeros((2, columns), bool)
    occupied[:, :value] = True
    zero = np.zeros(occupied.shape)
    return OccupancyGrid(
        resolution=0.05,
        corner=corner,
        evidence=zero,
        probability=zero,
        occupied=occupied,
        free=~occupied,
        looks=zero,
        footprint=zero.astype(int),
    )


def pair(text, folder):
    """Origin of the grid that a YAML file tells, and its image."""
    values = dict(re.findall(r"(\w+): (.*)", text))
    return tuple(json.loads(values["origin"])[:2]), (folder / json.loads(values["image"])).read_bytes()


@pytest.mark.parametrize("earlier_run", [False, True])
def test_a_reader_never_combines_two_grids(earlier_run, tmp_path, monkeypatch):
    """At every moment, also with the YAML file of the write before; in the end there are only the usual names."""
    grids = [small_grid((-k, 0), 5 + k, 1 + k % 4) for k in (0, 1, 1, 2, 3, 3, 4)]
    file = tmp_path / "m.yaml"
    if earlier_run:
        save_nav2(small_grid((9, 9), 3, 1), file)
    valid = {(grid.origin, b"%d 2" % grid.free.shape[1]) for grid in [*grids, small_grid((9, 9), 3, 1)]}
    texts = [file.read_text()] if earlier_run else []

    def check():
        for text in {*texts[-1:], *([file.read_text()] if file.exists() else [])}:
            origin, image = pair(text, tmp_path)
            assert any(np.allclose(origin, known) and image.split(b"\n")[1] == size for known, size in valid), (
                origin,
                image[:12],
            )

    import jaxsonar.occupancy.nav2_map as module

    original = module.atomic_write

    class Checked:
        def __init__(self, *arguments, **options):
            self.inner = original(*arguments, **options)

        def __enter__(self):
            return self.inner.__enter__()

        def __exit__(self, *error):
            result = self.inner.__exit__(*error)
            check()
            return result

    monkeypatch.setattr(module, "atomic_write", Checked)
    files = GridFiles(file)
    for grid in grids:
        files.write(grid)
        texts.append(file.read_text())
    texts.clear()
    files.finish()
    assert {one.name for one in tmp_path.iterdir()} == {"m.yaml", grid_image_filename(file).name}
    assert pair(file.read_text(), tmp_path)[0] == pytest.approx(grids[-1].origin)
