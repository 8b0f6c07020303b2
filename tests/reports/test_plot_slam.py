"""The figure of a SLAM run: all given data are drawn, ellipses have the right size, narrow plans keep their legend."""

from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.patches import Ellipse

from jaxsonar import GlobalMap, Room, SonarError
from jaxsonar.estimation.trajectory import Trajectory
from jaxsonar.reports import plot_style
from jaxsonar.reports.plot_slam import ELLIPSE_PROBABILITY, ELLIPSE_SIGMAS, MAX_ELLIPSES, ellipses, slam_figure

WALLS = np.array([[[0.0, 1.0], [9.0, 1.0]], [[0.0, -1.0], [9.0, -1.0]], [[9.0, -1.0], [9.0, 1.0]]])


def world(segments=WALLS):
    count, none = len(segments), np.zeros(len(segments))
    points = {"points": np.array([[9.0, 1.0], [0.0, 1.0]]), "point_kinds": ("corner", "edge")} if count else {}
    return GlobalMap(segments, none, none, none, none, np.zeros(count, int), ((),) * count, **points)


def out_and_back(sd=0.02):
    x = np.concatenate([np.linspace(0.5, 8, 40), np.linspace(8, 0.5, 40)])
    poses = np.column_stack([x, 0.1 * np.sin(x), np.repeat([0.0, np.pi], 40)])
    covariance = np.arange(80)[:, None, None] / 80 * np.diag([sd**2, sd**2 / 4, 1e-4])
    return Trajectory(np.arange(80.0), poses, covariance)


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_all_given_data_are_in_the_legend():
    run = out_and_back()
    odometry = run.poses + np.array([0.0, 0.3, 0.0])
    odometry[5] = np.nan
    figure = slam_figure(
        world(),
        run,
        odometry=odometry,
        truth=run.poses + np.array([0.0, 0.01, 0.0]),
        closures=np.array([[3, 76], [5, 74]]),
        withdrawn=np.array([[10, 60]]),
        room=Room(WALLS, poles=np.array([[4.0, 0.5]])),
    )
    told = " | ".join(labels(figure))
    for name in (
        "odometry",
        "true trajectory",
        "estimated trajectory",
        "start",
        "2 sigma (86 %)",
        "loop closure",
        "withdrawn",
    ):
        assert name in told
    for name in ("wall", "corner", "edge", "true wall", "pole"):
        assert name in labels(figure)
    axes = figure.axes[0]
    assert axes.get_title(loc="left") == "15.0 m driven, 3 walls, 2 loop closures"
    assert axes.get_aspect() == 1
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
    lines = [one for one in axes.collections if isinstance(one, LineCollection)]
    assert sorted(len(one.get_segments()) for one in lines) == [1, 2, 3, 3]


def test_missing_data_are_not_in_the_legend():
    figure = slam_figure(world(), Trajectory(np.arange(2.0), np.zeros((2, 3))))
    assert labels(figure) == ["estimated trajectory", "start", "wall", "corner", "edge"]
    empty = slam_figure(world(WALLS[:0]), Trajectory(np.zeros(0), np.zeros((0, 3))), title="none $of it")
    assert labels(empty) == ["estimated trajectory", "wall"]
    assert plot_style.render_figure(empty, "png").startswith(b"\x89PNG")


@pytest.mark.parametrize("sd", [0.0, 1e-4, 0.02, 0.5])
def test_ellipses_have_the_stated_size(sd):
    run = out_and_back(sd)
    figure = slam_figure(world(), run)
    drawn = [one for one in figure.axes[0].patches if isinstance(one, Ellipse)]
    assert 0 < len(drawn) <= MAX_ELLIPSES
    (told,) = [label for label in labels(figure) if "sigma" in label]
    times = int(told.split(", ")[1].split()[0]) if "," in told else 1
    last = drawn[-1]
    np.testing.assert_allclose(last.get_width(), 2 * ELLIPSE_SIGMAS * times * sd * np.sqrt(79 / 80), rtol=1e-9)
    assert times == {0.0: 1, 1e-4: 500, 0.02: 5, 0.5: 1}[sd], "of a path of 7.5 m"


def test_ellipses_contain_the_stated_fraction(rng):
    root = rng.normal(size=(2, 2))
    covariance = root @ root.T
    halves, turn = ellipses(covariance[None])
    points = rng.normal(size=(20000, 2)) @ root.T
    c, s = np.cos(turn[0]), np.sin(turn[0])
    own = points @ np.array([[c, -s], [s, c]])
    assert halves[0, 0] >= halves[0, 1]
    np.testing.assert_allclose(np.mean(((own / halves[0]) ** 2).sum(axis=1) <= 1), ELLIPSE_PROBABILITY, atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_everything_is_inside_the_figure(turn):
    """Including the legend of a narrow plan."""
    run = out_and_back(0.002).transform(np.array([0.0, 0.0, turn]))
    c, s = np.cos(turn), np.sin(turn)
    segments = WALLS @ np.array([[c, s], [-s, c]])
    figure = slam_figure(world(segments), run, odometry=run.poses, truth=run.poses, withdrawn=np.array([[0, 9]]))
    FigureCanvasAgg(figure).draw()
    width, height = figure.bbox.size
    for box in (figure.legends[0].get_window_extent(), figure.axes[0].get_tightbbox()):
        assert box is not None
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
    legend, axes = figure.legends[0].get_window_extent(), figure.axes[0].get_tightbbox()
    assert axes is not None
    assert legend.y1 <= axes.y0, "outside of the data"


@pytest.mark.slow
def test_the_suffix_selects_the_format(tmp_path):
    figure = slam_figure(world(), out_and_back())
    for suffix in ("svg", "png"):
        plot_style.save_figure(figure, tmp_path / f"a.{suffix}")
    assert ElementTree.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    again = slam_figure(world(), out_and_back())
    assert plot_style.render_figure(again, "svg") == (tmp_path / "a.svg").read_bytes()
    with pytest.raises(SonarError, match="gif"):
        plot_style.save_figure(figure, tmp_path / "a.gif")
