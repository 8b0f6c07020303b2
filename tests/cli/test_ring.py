"""``jaxsonar ring``: what a ring is, its bounds as a table, JSON and figure, and invalid calls."""

import json
from dataclasses import replace

import pytest
from support.commands import RING, call

from jaxsonar import load_ring
from jaxsonar.observability import ring_bounds as ring_bounds_module
from jaxsonar.observability.settings import SETTINGS


@pytest.fixture
def few(tmp_path, monkeypatch):
    """Few scenes, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    full = ring_bounds_module.ring_bounds
    settings = replace(SETTINGS, bearings=3, trials=12, steps=4)
    monkeypatch.setattr(ring_bounds_module, "ring_bounds", lambda ring, **more: full(ring, settings=settings, **more))


def test_a_ring_is_described(capsys):
    assert call("ring", "faw") == 0
    assert capsys.readouterr().out.splitlines() == [
        "FAW ring: 24 sensors in a closed ring, 560 x 560 mm",
        "cones 60 deg, echoes up to 2 m, speed of sound 343.2 m/s",
        "168 echo paths: 24 direct, 144 cross (up to neighbor 3)",
        "8 firing groups of 3; a scan takes 93 ms or more",
    ]
    assert call("ring", "bumper4") == 0
    assert "4 sensors in an open array, 0 x 1350 mm" in capsys.readouterr().out


def test_the_bounds_are_printed_written_and_drawn(few, tmp_path, capsys):
    assert call("ring", "bumper4", "--bounds", "--sigma", "0.003", "--json", "b.json", "--figure", "b.svg") == 0
    printed = capsys.readouterr().out
    assert "one shot of sensor 1" in printed
    assert "sigma = 3 mm" in printed
    assert printed.count("1.25 │") == 2
    table = json.loads((tmp_path / "b.json").read_text())
    assert table["sigma"] == 0.003
    rows = table["scan"]
    assert [row["distance"] for row in rows] == ring_bounds_module.distances_of(load_ring("bumper4"))
    assert rows[2]["range_sd"]["plane"] == pytest.approx(3 * 0.26e-3, rel=0.02)
    assert rows[2]["radius_sd"]["0.2"] == pytest.approx(3 * 6e-3, rel=0.02)
    assert (tmp_path / "b.svg").read_text().startswith("<?xml")


def test_json_on_standard_output_is_alone(few, capsys):
    assert call("ring", "corridor8", "--bounds", "--json", "-") == 0
    assert json.loads(capsys.readouterr().out)["sigma"] == 0.001


def test_a_ring_that_is_probably_wrong_gets_a_warning(tmp_path, capsys):
    file = tmp_path / "ring.toml"
    file.write_text(RING.replace("radius = 0.28", "radius = 28"))
    assert call("ring", file) == 0
    assert "warning: " in capsys.readouterr().err
    assert call("ring", file, "--strict") == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["ring", "fow"], "no such ring"),
        (["ring", "faw", "--sigma", "0.001"], "--sigma came without --bounds"),
        (["ring", "faw", "--figure", "a.svg"], "--figure came without --bounds"),
        (["ring", "faw", "--json", "-"], "--json came without --bounds"),
        (["ring", "faw", "--bounds", "--sigma", "3"], "is it in mm?"),
        (["ring", "faw", "--bounds", "--figure", "a.txt"], ".svg"),
        (["ring", "faw", "--bounds", "--figure", "no/a.svg"], "no/a.svg"),
    ],
)
def test_an_invalid_call_is_refused_before_the_computation(arguments, message, few, capsys):
    assert call(*arguments) == 2
    assert message in capsys.readouterr().err
