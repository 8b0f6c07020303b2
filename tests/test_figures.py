"""Figures: each draws whatever a scan holds, files are what their suffix says, arcs lie where echoes may come from."""

import itertools
from functools import partial
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxsonar import LocalModel, Log, Ring, Room, Scan, SonarError, figures, local_model, simulate
from jaxsonar.office import load_office

BUMPER = Ring(
    [(0.6, -0.3), (0.65, -0.1), (0.65, 0.1), (0.6, 0.3)],
    np.radians([-15.0, -5.0, 5.0, 15.0]),
    beam=np.radians([70.0, 60.0, 60.0, 50.0]),
    neighbors=3,
    max_range=2.5,
    range_offset=[0.01, -0.02, 0.03, 0.0],
    speed_of_sound=340.0,
    name="bumper",
)
BACK_TO_BACK = Ring([(0.1, 0.0), (-0.1, 0.0)], [0.0, np.pi], beam=0.5, neighbors=1, max_range=2.0)
LONE = Ring([(0.0, 0.0)], [0.3], beam=np.pi, neighbors=0, max_range=1.5)
POLES = Room(np.zeros((0, 2, 2)), poles=np.array([[1.2, 0.1], [0.3, 0.9]]))
WALL = Room(np.array([[[1.4, -2.0], [1.5, 2.0]]]))


class Case(NamedTuple):
    """Everything that a figure may show."""

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
    """Echoes beyond the maximum range, and of a pair that the ring does not listen to."""
    ring = Ring.circular()
    log = Log.from_echoes(
        np.zeros(3, int), np.array([0, 1, 2]), np.array([0, 12, 2]), np.array([2.0, 1.0, 7.0]),
        stamp=np.zeros(1), pose=np.zeros((1, 3)),
    )  # fmt: skip
    return Case(ring, WALL, np.zeros(3), log[0], LocalModel(0, 0.0, ()))


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
    "ring": lambda case: figures.ring_figure(case.ring),
    "last sensor fires": lambda case: figures.ring_figure(case.ring, transmitter=case.ring.count - 1, reach=0.9),
    "reference": lambda case: figures.reference_figure(case.room, case.pose, ring=case.ring),
    "arcs": lambda case: figures.arcs_figure(case.ring, case.scan),
    "arcs in the room": lambda case: figures.arcs_figure(case.ring, case.scan, room=case.room, pose=case.pose),
    "lines": lambda case: figures.lines_figure(case.ring, case.scan, case.model),
    "lines in the room": lambda case: figures.lines_figure(
        case.ring, case.scan, case.model, room=case.room, pose=case.pose
    ),
    "accumulator": lambda case: figures.accumulator_figure(case.ring, case.scan, case.model),
    "aggregate": lambda case: figures.aggregate_figure(case.ring, [case.model] * 2, np.stack([case.pose] * 2)),
    "aggregate in the room": lambda case: figures.aggregate_figure(
        case.ring, [case.model], case.pose[None], room=case.room
    ),
}


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return CASES[request.param]()


@pytest.mark.parametrize("draw", DRAW.values(), ids=DRAW)
def test_every_figure_draws_whatever_there_is(case, draw):
    """Warnings are errors here, and the canvas draws everything once."""
    figure = draw(case)
    assert isinstance(figure, Figure)
    figure.set_dpi(30)
    figure.canvas.draw()
    assert np.isfinite(figure.get_size_inches()).all()
    assert 1 < figure.get_size_inches()[1] < 40
    for axes in figure.axes:
        assert np.isfinite([*axes.get_xlim(), *axes.get_ylim()]).all()


def test_every_public_function_that_draws_is_in_the_table():
    drawing = {name for name in vars(figures) if name.endswith("_figure") and not name.startswith("_")}
    assert drawing == {f"{name.split()[0]}_figure" for name in DRAW if name != "last sensor fires"}


def test_drawing_leaves_no_trace_in_the_style():
    """A program that draws its own figures keeps its own style."""
    import matplotlib

    before = dict(matplotlib.rcParams)
    figures.ring_figure(LONE)
    assert dict(matplotlib.rcParams) == before


def test_arcs_of_a_scan_are_all_paths_that_can_hear(faw_ring):
    """As many curves as there are paths with overlapping cones and no echo, plus the echoes."""
    here = office()
    axes = figures.arcs_figure(here.ring, here.scan).axes[0]
    silent, cross, direct = (len(collection.get_paths()) for collection in axes.collections)
    heard = set(zip(here.scan.tx.tolist(), here.scan.rx.tolist(), strict=True))
    assert silent == len(here.ring.paths) - len(heard)
    assert direct == int((here.scan.tx == here.scan.rx).sum())
    assert cross == int((here.scan.tx != here.scan.rx).sum())


# Files


@pytest.fixture(scope="module")
def figure():
    return figures.ring_figure(BUMPER)


def svg_names(path):
    return {element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()}


def test_svg_is_xml_and_the_same_twice(figure, tmp_path):
    figures.save(figure, tmp_path / "a.svg")
    figures.save(figures.ring_figure(BUMPER), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert {"svg", "path", "g"} <= svg_names(tmp_path / "a.svg")


@pytest.mark.parametrize("name", ["arcs in the room", "accumulator", "aggregate in the room"])
def test_every_svg_is_the_same_twice(tmp_path, name):
    case = office()
    for file in ("a.svg", "b.svg"):
        figures.save(DRAW[name](case), tmp_path / file)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_png_and_pdf(figure, tmp_path):
    figures.save(figure, str(tmp_path / "a.PNG"))
    head = (tmp_path / "a.PNG").read_bytes()
    assert head.startswith(b"\x89PNG\r\n\x1a\n")
    assert head[12:16] == b"IHDR"
    width, height = (int.from_bytes(head[k : k + 4], "big") for k in (16, 20))
    np.testing.assert_allclose([width, height], figure.get_size_inches() * 160, atol=1)
    figures.save(figure, tmp_path / "a.pdf")
    body = (tmp_path / "a.pdf").read_bytes()
    assert body.startswith(b"%PDF")
    assert body.rstrip().endswith(b"%%EOF")


@pytest.mark.parametrize("name", ["a.gif", "a", "svg", "a.svg.txt"])
def test_another_suffix_is_refused(figure, tmp_path, name):
    with pytest.raises(SonarError, match=r"allowed are \.svg, \.png, \.pdf"):
        figures.save(figure, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(figure, tmp_path):
    with pytest.raises(SonarError, match=r"no/a\.png.*cannot write"):
        figures.save(figure, tmp_path / "no" / "a.png")


def test_a_failure_leaves_the_old_figure(tmp_path):
    class Broken(Figure):
        def savefig(self, fname, **options):
            fname.write(b"half")
            raise RuntimeError("no more ink")

    (tmp_path / "a.svg").write_text("old")
    with pytest.raises(RuntimeError, match="no more ink"):
        figures.save(Broken(), tmp_path / "a.svg")
    assert [path.name for path in tmp_path.iterdir()] == ["a.svg"]
    assert (tmp_path / "a.svg").read_text() == "old"


# Arcs


@pytest.mark.parametrize("ring", [Ring.circular(), BUMPER, Ring.circular(count=8, beam=2.0, neighbors=2)])
def test_arc_points_lie_at_the_path_length(ring, rng):
    """From transmitter to point to receiver it is twice the range, wherever on the arc."""
    rows = np.flatnonzero(np.asarray(ring.echo_paths.width) > 0)
    reach = rng.uniform(0.6, ring.max_range, len(rows))
    points = figures.arc_points(ring, rows, reach, points=9)
    assert points.shape == (len(rows), 9, 2)
    for row, length, arc in zip(rows, reach, points, strict=True):
        tx, rx = np.asarray(ring.position)[ring.paths[row]]
        for point in arc:
            assert np.linalg.norm(point - tx) + np.linalg.norm(point - rx) == pytest.approx(2 * length, abs=1e-5)


def test_arcs_span_the_detection_range(faw_ring):
    """A plane square to the arc at its ends is heard from just there: the normal halves the angle at the point."""
    rows = np.arange(len(faw_ring.paths))
    points = figures.arc_points(faw_ring, rows, np.full(len(rows), 1.3), points=5)
    for row, arc in zip(rows, points, strict=True):
        tx, rx = faw_ring.position[faw_ring.paths[row]]
        for end, wanted in zip((arc[0], arc[-1]), np.asarray(faw_ring.detection_ranges)[row], strict=True):
            out, back = end - tx, end - rx
            normal = out / np.linalg.norm(out) + back / np.linalg.norm(back)
            apart = np.arctan2(normal[1], normal[0]) - wanted
            assert abs((apart + np.pi) % (2 * np.pi) - np.pi) < 1e-4


def test_arcs_turn_with_the_ring(faw_ring):
    """One sensor further along, an arc is the same one turned by 15 degrees."""
    rows = faw_ring.path_index[[3, 4, 4, 5], [3, 4, 6, 7]]
    a, b, c, d = figures.arc_points(faw_ring, rows, np.full(4, 1.1))
    cos, sin = np.cos(np.radians(15)), np.sin(np.radians(15))
    turn = np.array([[cos, sin], [-sin, cos]])
    np.testing.assert_allclose(a @ turn, b, atol=1e-6)
    np.testing.assert_allclose(c @ turn, d, atol=1e-6)


def test_swapped_sensors_share_an_arc(faw_ring):
    for tx, rx in itertools.pairwise(range(6)):
        rows = faw_ring.path_index[[tx, rx], [rx, tx]]
        there, back = figures.arc_points(faw_ring, rows, np.full(2, 0.9))
        np.testing.assert_allclose(there, back, atol=1e-6)
