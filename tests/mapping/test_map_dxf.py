"""CAD drawings: round trip in metres, and reproducible bytes."""

import sys

import numpy as np
import pytest

from jaxsonar import SonarError
from jaxsonar.mapping.global_map import GlobalMap
from jaxsonar.mapping.map_dxf import LAYER, save_dxf


def a_map(segments):
    segments = np.asarray(segments, float).reshape(-1, 2, 2)
    nothing = np.full(len(segments), np.nan)
    none = np.zeros(len(segments), int)
    return GlobalMap(segments, nothing, nothing, nothing, nothing, none, ((),) * len(segments))


@pytest.fixture
def ezdxf():
    return pytest.importorskip("ezdxf")


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 40])
def test_a_drawing_is_read_back(ezdxf, rng, tmp_path, count):
    world = a_map(rng.uniform(-30, 30, (count, 2, 2)))
    save_dxf(world, tmp_path / "map.dxf")
    drawing = ezdxf.readfile(tmp_path / "map.dxf")
    assert drawing.header["$INSUNITS"] == 6
    assert not drawing.audit().errors
    lines = list(drawing.modelspace())
    assert {(line.dxftype(), line.dxf.layer) for line in lines} <= {("LINE", LAYER)}
    assert LAYER in drawing.layers
    ends = np.array([[line.dxf.start, line.dxf.end] for line in lines]).reshape(-1, 2, 3)
    np.testing.assert_array_equal(ends[..., :2], world.segments)
    np.testing.assert_array_equal(ends[..., 2], 0)


@pytest.mark.slow
def test_the_initial_view_contains_all_walls(ezdxf, tmp_path):
    """A corridor of 25 m along y; the view has a given height, and programs make it at least as wide."""
    world = a_map([[[3, 0], [3, 25]], [[5, 0], [5, 25]]])
    save_dxf(world, tmp_path / "map.dxf")
    (view,) = ezdxf.readfile(tmp_path / "map.dxf").viewports.get("*Active")
    assert (view.dxf.center.x, view.dxf.center.y) == (4, 12.5)
    assert view.dxf.height >= 25


@pytest.mark.slow
def test_the_same_map_gives_the_same_bytes(ezdxf, rng, tmp_path, monkeypatch):
    """Also if a year passes between the two writes."""
    import datetime

    import ezdxf.document

    class Later(datetime.datetime):
        @classmethod
        def now(cls, tz=None):
            return super().now(tz) + datetime.timedelta(days=365)

    world = a_map(rng.uniform(-3, 3, (5, 2, 2)))
    save_dxf(world, tmp_path / "a.dxf")
    monkeypatch.setattr(ezdxf.document, "datetime", Later)
    save_dxf(world, tmp_path / "b.dxf")
    assert (tmp_path / "a.dxf").read_bytes() == (tmp_path / "b.dxf").read_bytes()


@pytest.mark.slow
def test_other_drawings_keep_their_dates(ezdxf, tmp_path):
    save_dxf(a_map([]), tmp_path / "map.dxf")
    assert not ezdxf.options.write_fixed_meta_data_for_testing


def test_a_missing_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(SonarError, match=r"map\.dxf: DXF needs the cad extra: pip install 'jaxsonar\[cad\]'$"):
        save_dxf(a_map([]), tmp_path / "map.dxf")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_file_that_cannot_be_written_is_named(ezdxf, tmp_path):
    with pytest.raises(SonarError, match=r"no/map\.dxf.*cannot write"):
        save_dxf(a_map([]), tmp_path / "no" / "map.dxf")
