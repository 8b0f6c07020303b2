"""Figures draw any scan, files have the format of their suffix, and arcs are where reflectors can be."""

import itertools
from functools import partial
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from support.hard_cones import simulate
from support.rings import bumper_ring

from jaxsonar import LocalModel, Log, Ring, Room, Scan, SonarError, local_model, local_models
from jaxsonar.evaluation.laser_polygonal_model import PolygonalModel
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.occupancy.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from jaxsonar.reports import plot_grid, plot_map, plot_scan, plot_style
from jaxsonar.reports.plot_grid import GridPanel
from jaxsonar.simulation.office import load_office

BUMPER = bumper_ring([70.0, 60.0, 60.0, 50.0], name="bumper")
BACK_TO_BACK = Ring([(0.1, 0.0), (-0.1, 0.0)], [0.0, np.pi], beam=0.5, neighbors=1, max_range=2.0)
LONE = Ring([(0.0, 0.0)], [0.3], beam=np.pi, neighbors=0, max_range=1.5)
POLES = Room(np.zeros((0, 2, 2)), poles=np.array([[1.2, 0.1], [0.3, 0.9]]))
WALL = Room(np.array([[[1.4, -2.0], [1.5, 2.0]]]))


class Case(NamedTuple):
    """All data that a figure can show."""

    ring: Ring
    room: Room
    pose: np.ndarray
    scan: Scan
    model: LocalModel


def a_case(ring, room, pose):
    pose = np.asarray(pose, float)
    heard = simulate(ring, room, pose[None], sigma=0.003, seed=1)
    scan = heard.as_log(ring, pose[None])[0]
    return Case(ring, room, pose, scan, local_model(ring, scan))


def a_silent_scan():
    none = np.zeros(0, int)
    return Log.from_echoes(none, none, none, np.zeros(0), stamp=np.array([np.nan]), pose=np.full((1, 3), np.nan))[0]


def office():
    shipped = load_office()
    return a_case(shipped.ring, shipped.room, shipped.poses[0])


def silence():
    """A scan without echoes, a model without lines."""
    shipped, scan = load_office(), a_silent_scan()
    return Case(shipped.ring, shipped.room, shipped.poses[3], scan, local_model(shipped.ring, scan))


def beyond():
    """Echoes beyond the maximum range, and of a sensor pair that is no path."""
    ring = Ring.circular()
    log = Log.from_echoes(
        np.zeros(3, int), np.array([0, 1, 2]), np.array([0, 12, 2]), np.array([2.0, 1.0, 7.0]),
        stamp=np.zeros(1), pose=np.zeros((1, 3)),
    )  # fmt: skip
    return Case(ring, WALL, np.zeros(3), log[0], LocalModel(0, 0.0, ()))


def map_of(segments):
    """A map from segments only; their other properties are not drawn."""
    segments = np.asarray(segments, float).reshape(-1, 2, 2)
    unknown = np.full(len(segments), np.nan)
    none = np.zeros(len(segments), int)
    return GlobalMap(segments, unknown, unknown, unknown, unknown, none, ((),) * len(segments))


def a_map(case):
    return map_of(plot_map.aggregated_segments([case.model], case.pose[None]))


GRID = np.full((30, 40), UNKNOWN, np.uint8)
GRID[5:25, 5:35] = OCCUPIED
GRID[6:24, 6:34] = FREE
CASES = {
    "office": office,
    "bumper": partial(a_case, BUMPER, WALL, (0.1, 0.2, 0.05)),
    "poles": partial(a_case, Ring.circular(), POLES, (0.0, 0.0, 2.0)),
    "one sensor": partial(a_case, LONE, WALL, (0.0, 0.0, 0.0)),
    "back to back": partial(a_case, BACK_TO_BACK, WALL, (0.0, 0.0, 0.0)),
    "silence": silence,
    "beyond": beyond,
}
DRAW = {
    "ring": lambda case: plot_scan.ring_figure(case.ring),
    "last sensor fires": lambda case: plot_scan.ring_figure(case.ring, transmitter=case.ring.count - 1, arc_range=0.9),
    "arcs": lambda case: plot_scan.arcs_figure(case.ring, case.scan),
    "arcs in the room": lambda case: plot_scan.arcs_figure(case.ring, case.scan, room=case.room, pose=case.pose),
    "lines": lambda case: plot_scan.lines_figure(case.ring, case.scan, case.model),
    "lines in the room": lambda case: plot_scan.lines_figure(
        case.ring, case.scan, case.model, room=case.room, pose=case.pose
    ),
    "accumulator": lambda case: plot_scan.accumulator_figure(case.ring, case.scan, case.model),
    "aggregate": lambda case: plot_map.aggregate_figure(case.ring, [case.model] * 2, np.stack([case.pose] * 2)),
    "aggregate in the room": lambda case: plot_map.aggregate_figure(
        case.ring, [case.model], case.pose[None], room=case.room
    ),
    "modeling": lambda case: plot_map.modeling_figure(case.ring, [case.model], case.pose[None], scans=[0]),
    "modeling in the room": lambda case: plot_map.modeling_figure(
        case.ring,
        [case.model] * 2,
        np.stack([case.pose] * 2),
        scans=[1, 0],
        near=(0.0, 0.0),
        within=1.7,
        room=case.room,
    ),
    "map": lambda case: plot_map.map_figure(a_map(case)),
    "map with all": lambda case: plot_map.map_figure(
        a_map(case),
        aggregated=plot_map.aggregated_segments([case.model], case.pose[None]),
        poses=case.pose[None],
        room=case.room,
        reference=case.room.walls + 0.1,
        laser_points=case.room.walls.reshape(-1, 2),
        title="All",
    ),
    "laser": lambda case: plot_map.laser_figure(case.room.walls, case.room.walls.reshape(-1, 2)),
    "laser scan": lambda case: plot_map.laser_figure(
        PolygonalModel(case.room.walls, case.room.walls + 0.2, case.room.walls[:, 0]), case.room.walls[:, 1]
    ),
    "grid": lambda case: plot_grid.grid_figure(GridPanel("Grid", GRID, 0.1, (-1.0, 2.0))),
    "grid in the room": lambda case: plot_grid.grid_figure(
        GridPanel("Grid", GRID, 0.1, (-1.0, 2.0)), room=case.room, poses=np.array([[0.5, 0.2, 0.0]])
    ),
    "grid_comparison": lambda case: plot_grid.grid_comparison_figure(
        [GridPanel("A", GRID, 0.1, (-1.0, 2.0)), GridPanel("B", GRID, 0.2, (0.0, 0.0))], room=case.room
    ),
}


def drawn(figure):
    """A canvas on which the figure is rendered; a figure's own canvas renders nothing."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return CASES[request.param]()


@pytest.mark.slow
@pytest.mark.parametrize("draw", DRAW.values(), ids=DRAW)
def test_every_figure_can_be_drawn(case, draw):
    """Warnings are errors in tests, and the canvas renders everything once."""
    figure = draw(case)
    assert isinstance(figure, Figure)
    figure.set_dpi(30)
    drawn(figure)
    assert np.isfinite(figure.get_size_inches()).all()
    assert 1 < figure.get_size_inches()[1] < 40
    for axes in figure.axes:
        assert np.isfinite([*axes.get_xlim(), *axes.get_ylim()]).all()


def test_every_figure_function_is_tested():
    modules = (plot_scan, plot_map, plot_grid)
    drawing = {name for module in modules for name in vars(module) if name.endswith("_figure")}
    assert drawing == {f"{name.split()[0]}_figure" for name in DRAW if name != "last sensor fires"}


@pytest.mark.slow
def test_drawing_does_not_change_the_global_style():
    """A program that draws its own figures keeps its own style."""
    import matplotlib

    before = dict(matplotlib.rcParams)
    plot_scan.ring_figure(LONE)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.slow
def test_all_audible_paths_of_a_scan_have_an_arc(faw_ring):
    """As many curves as there are paths with overlapping cones and no echo, plus the echoes."""
    here = office()
    axes = plot_scan.arcs_figure(here.ring, here.scan).axes[0]
    silent, cross, direct = (len(collection.get_paths()) for collection in axes.collections)
    heard = set(zip(here.scan.tx.tolist(), here.scan.rx.tolist(), strict=True))
    assert silent == len(here.ring.paths) - len(heard)
    assert direct == int((here.scan.tx == here.scan.rx).sum())
    assert cross == int((here.scan.tx != here.scan.rx).sum())


@pytest.mark.slow
def test_arcs_show_what_was_measured_and_when():
    """Silence only of measured paths; old readings dashed; each arc where the robot was."""
    ring = Ring.circular(count=8, neighbors=0)
    time = np.array([-1.0, 1.0])
    tx = np.array([0, 1, 2, 5])
    log = Log.from_echoes(
        np.zeros(4, int), tx, tx, np.array([1.0, 1.0, 1.0, np.nan]),
        t=np.array([0.0, 0.5, 0.0, 0.5]), age=np.array([0.0, 0.0, 0.25, 0.0]), stamp=np.zeros(1), pose=np.zeros((1, 3)),
        odometry=np.column_stack([time, 2 * time, np.zeros((2, 2))]),
    )  # fmt: skip
    axes = plot_scan.arcs_figure(ring, log[0]).axes[0]
    drawn = [np.array(arcs.get_segments()) for arcs in axes.collections if isinstance(arcs, LineCollection)]
    silent, direct, old = (segments.mean(axis=1) for segments in drawn if len(segments))
    at_rest = plot_scan.arc_points(ring, np.array([5, 0, 1, 2]), np.array([2.0, 1.0, 1.0, 1.0])).mean(axis=1)
    found = np.concatenate([silent, direct, old])
    np.testing.assert_allclose(found - at_rest, [[1, 0], [0, 0], [1, 0], [-0.5, 0]], atol=1e-5)
    assert "3 echoes on 4 measured paths of 8" in axes.get_title(loc="left")


# Many scans


def test_outermost_reflection_lines_end_where_the_segment_ends():
    """The reflection lines give the same endpoints as the kernel (paper, section 5)."""
    case = office()
    assert case.model.lines
    for line in case.model.lines:
        rays = plot_map.reflection_lines(case.ring, line)
        assert len(rays) == len(line.paths)
        feet = rays[[0, -1], 1]
        feet = (
            feet
            if np.linalg.norm(feet[0] - line.segment[0]) < np.linalg.norm(feet[1] - line.segment[0])
            else feet[::-1]
        )
        np.testing.assert_allclose(feet, line.segment, atol=1e-5)
        along = line.segment[1] - line.segment[0]
        np.testing.assert_allclose((rays[:, 1] - rays[:, 0]) @ along, 0, atol=1e-5)


@pytest.mark.slow
def test_a_detail_excludes_distant_segments():
    """Two walls at one corner of the office, from three positions."""
    shipped = load_office()
    heard = simulate(shipped.ring, shipped.room, shipped.poses, sigma=0.003, seed=1)
    models = list(local_models(shipped.ring, heard.as_log(shipped.ring, shipped.poses)))
    draw = partial(plot_map.modeling_figure, shipped.ring, models, shipped.poses, scans=(0, 1, 2))

    def bold(figure):
        return sum(line.get_linewidth() == 4 for line in figure.axes[0].lines)

    assert bold(draw()) == sum(len(model.lines) for model in models[:3])
    assert bold(draw(near=(-1.47, -1.96), within=2.5)) == 6
    assert bold(draw(near=(-1.47, -1.96), within=0.1)) == 0


@pytest.mark.parametrize(("poses", "numbers"), [(0, 0), (1, 1), (40, 40), (41, 0), (2000, 0)])
def test_many_positions_are_a_trajectory_without_numbers(poses, numbers):
    path = np.stack([np.linspace(0, 25, poses), np.ones(poses), np.zeros(poses)], axis=-1)
    axes = plot_map.map_figure(map_of([[[0, 0], [25, 0]]]), poses=path).axes[0]
    assert len(axes.texts) == numbers
    line, crosses = axes.lines
    assert np.size(line.get_xdata()) == poses
    assert np.size(crosses.get_xdata()) <= plot_map.MAX_NUMBERED_POSES


@pytest.mark.slow
@pytest.mark.parametrize("size", [(25, 4), (4, 25), (4, 4), (200, 1), (1, 200), (0.3, 0.3)])
def test_the_figure_size_fits_the_plan(size):
    """Corridors along x get wide figures, along y figures of limited height; both axes have the same scale."""
    x, y = size
    walls = [[[0, 0], [x, 0]], [[0, y], [x, y]], [[0, 0], [0, y]]]
    figure = plot_map.map_figure(map_of(walls), poses=np.array([[0.0, 0.0, 0.0]]), room=Room(np.array(walls, float)))
    width, height = figure.get_size_inches()
    assert 4 <= width <= 10
    assert 1.2 < height <= 11
    drawn(figure)
    axes = figure.axes[0]
    (left, low), (right, top) = axes.transData.transform([(0, 0), (x, y)]) / figure.dpi
    assert (right - left) / x == pytest.approx((top - low) / y)
    assert max(right - left, top - low) > 0.6 * max(width, height) or x == y
    assert figure.legends[0].get_window_extent().x0 >= 0


def test_every_end_of_a_segment_has_a_tick_across():
    world = map_of([[[0, 0], [2, 0]], [[2, 0], [2, 3]]])
    axes = plot_map.map_figure(world).axes[0]
    _, ticks = axes.collections
    np.testing.assert_array_equal(ticks.get_offsets(), world.segments.reshape(-1, 2))
    across = np.array([np.diff(path.vertices, axis=0)[0] for path in ticks.get_paths()])
    along = np.repeat(world.segments[:, 1] - world.segments[:, 0], 2, axis=0)
    np.testing.assert_allclose((across * along).sum(axis=-1), 0)
    np.testing.assert_allclose(np.linalg.norm(across, axis=-1), 8)  # points


@pytest.mark.slow
def test_a_thousand_segments_are_few_elements(rng, tmp_path):
    """The number of artists does not grow with the number of scans."""
    ends = rng.uniform(0, 20, (1000, 2, 2))
    points = rng.uniform(0, 20, (100_000, 2))
    figure = plot_map.map_figure(map_of(ends[:100]), aggregated=ends, reference=ends, laser_points=points)
    assert len(figure.axes[0].get_children()) < 30
    plot_style.save_figure(figure, tmp_path / "a.svg")
    assert (tmp_path / "a.svg").stat().st_size < 3e6


def test_the_grid_lies_where_its_cells_are():
    """Row 0 is the top row, so the lower left cell is the first one of the last row."""
    image = np.full((3, 5), FREE, np.uint8)
    image[2, 0] = OCCUPIED
    figure = plot_grid.grid_figure(GridPanel("Grid", image, 0.5, (10.0, -4.0)))
    (shown,) = figure.axes[0].images
    assert shown.get_extent() == [10.0, 12.5, -4.0, -2.5]
    pixels = np.asarray(drawn(figure).buffer_rgba())[::-1, :, 0]
    for x, y, grey in ((10.25, -3.75, OCCUPIED), (10.25, -2.75, FREE), (12.25, -3.75, FREE), (9.9, -3.0, UNKNOWN)):
        column, row = figure.axes[0].transData.transform((x, y)).astype(int)
        assert pixels[row, column] == pytest.approx(255 * grey / FREE, abs=1)


def test_several_grids_are_shown_whole_and_at_one_scale():
    room = Room(np.array([[[-3.0, -1.0], [4.0, 2.5]]]))
    panels = [GridPanel(name, GRID, 0.1, (-1.0, 2.0)) for name in "AB"]
    figure = plot_grid.grid_comparison_figure([*panels, GridPanel("C", GRID, 0.5, (5.0, -2.0))], room=room)
    assert [axes.get_title() for axes in figure.axes] == ["A", "B", "C"]
    left, right = np.array([axes.get_xlim() for axes in figure.axes]).T
    assert np.ptp(left) == np.ptp(right) == 0
    assert left[0] < -3.0
    assert right[0] > 5.0 + 0.5 * GRID.shape[1]


# Files


@pytest.fixture(scope="module")
def figure():
    return plot_scan.ring_figure(BUMPER)


def svg_names(path):
    return {element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()}


@pytest.mark.slow
def test_svg_is_xml_and_the_same_twice(figure, tmp_path):
    plot_style.save_figure(figure, tmp_path / "a.svg")
    plot_style.save_figure(plot_scan.ring_figure(BUMPER), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert {"svg", "path", "g"} <= svg_names(tmp_path / "a.svg")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "arcs in the room",
        "accumulator",
        "aggregate in the room",
        "modeling in the room",
        "map with all",
        "grid_comparison",
    ],
)
def test_every_svg_is_the_same_twice(tmp_path, name):
    case = office()
    for file in ("a.svg", "b.svg"):
        plot_style.save_figure(DRAW[name](case), tmp_path / file)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


@pytest.mark.slow
def test_png_and_pdf(figure, tmp_path):
    plot_style.save_figure(figure, str(tmp_path / "a.PNG"))
    head = (tmp_path / "a.PNG").read_bytes()
    assert head.startswith(b"\x89PNG\r\n\x1a\n")
    assert head[12:16] == b"IHDR"
    width, height = (int.from_bytes(head[k : k + 4], "big") for k in (16, 20))
    np.testing.assert_allclose([width, height], figure.get_size_inches() * 160, atol=1)
    plot_style.save_figure(figure, tmp_path / "a.pdf")
    body = (tmp_path / "a.pdf").read_bytes()
    assert body.startswith(b"%PDF")
    assert body.rstrip().endswith(b"%%EOF")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a", "svg", "a.svg.txt"])
def test_another_suffix_is_rejected(figure, tmp_path, name):
    with pytest.raises(SonarError, match=r"allowed are \.svg, \.png, \.pdf"):
        plot_style.save_figure(figure, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_named(figure, tmp_path):
    with pytest.raises(SonarError, match=r"no/a\.png.*cannot write"):
        plot_style.save_figure(figure, tmp_path / "no" / "a.png")


def test_a_failed_write_keeps_the_old_figure(tmp_path):
    class Broken(Figure):
        def savefig(self, fname, **options):
            fname.write(b"half")
            raise RuntimeError("no more ink")

    (tmp_path / "a.svg").write_text("old")
    with pytest.raises(RuntimeError, match="no more ink"):
        plot_style.save_figure(Broken(), tmp_path / "a.svg")
    assert [path.name for path in tmp_path.iterdir()] == ["a.svg"]
    assert (tmp_path / "a.svg").read_text() == "old"


# Arcs


@pytest.mark.slow
@pytest.mark.parametrize("ring", [Ring.circular(), BUMPER, Ring.circular(count=8, beam=2.0, neighbors=2)])
def test_arc_points_lie_at_the_path_length(ring, rng):
    """The path transmitter - point - receiver has twice the range, for every point of the arc."""
    rows = np.flatnonzero(np.asarray(ring.echo_paths.width) > 0)
    reach = rng.uniform(0.6, ring.max_range, len(rows))
    points = plot_scan.arc_points(ring, rows, reach, points=9)
    assert points.shape == (len(rows), 9, 2)
    for row, length, arc in zip(rows, reach, points, strict=True):
        tx, rx = np.asarray(ring.position)[ring.paths[row]]
        for point in arc:
            assert np.linalg.norm(point - tx) + np.linalg.norm(point - rx) == pytest.approx(2 * length, abs=1e-5)


def test_arcs_span_the_detection_range(faw_ring):
    """The bisector at an endpoint of the arc is the normal of a plane at the edge of the detection range."""
    rows = np.arange(len(faw_ring.paths))
    points = plot_scan.arc_points(faw_ring, rows, np.full(len(rows), 1.3), points=5)
    for row, arc in zip(rows, points, strict=True):
        tx, rx = faw_ring.position[faw_ring.paths[row]]
        for end, wanted in zip((arc[0], arc[-1]), np.asarray(faw_ring.detection_ranges)[row], strict=True):
            out, back = end - tx, end - rx
            normal = out / np.linalg.norm(out) + back / np.linalg.norm(back)
            apart = np.arctan2(normal[1], normal[0]) - wanted
            assert abs((apart + np.pi) % (2 * np.pi) - np.pi) < 1e-4


def test_arcs_rotate_with_the_ring(faw_ring):
    """The arc of the next sensor is the same arc rotated by 15 degrees."""
    rows = faw_ring.path_index[[3, 4, 4, 5], [3, 4, 6, 7]]
    a, b, c, d = plot_scan.arc_points(faw_ring, rows, np.full(4, 1.1))
    cos, sin = np.cos(np.radians(15)), np.sin(np.radians(15))
    turn = np.array([[cos, sin], [-sin, cos]])
    np.testing.assert_allclose(a @ turn, b, atol=1e-6)
    np.testing.assert_allclose(c @ turn, d, atol=1e-6)


def test_swapped_sensors_share_an_arc(faw_ring):
    for tx, rx in itertools.pairwise(range(6)):
        rows = faw_ring.path_index[[tx, rx], [rx, tx]]
        there, back = plot_scan.arc_points(faw_ring, rows, np.full(2, 0.9))
        np.testing.assert_allclose(there, back, atol=1e-6)
