"""The demo writes the documented files, and the commands reproduce them."""

import tomllib

import numpy as np
import pytest
from support.demo_files import FILES

from jaxsonar import load_log, load_ring, load_room
from jaxsonar.cli import app as cli
from jaxsonar.demo import run_demo as demo
from jaxsonar.detection.settings_toml import load_settings


@pytest.mark.slow
def test_the_demo_writes_all_documented_files(written):
    folder, _, said = written
    assert {path.name for path in folder.iterdir()} == FILES
    assert all(path.stat().st_size > 100 for path in folder.iterdir())
    assert any("17 scans" in step for step in said)
    assert any("10 random poses in 2 random rooms" in step for step in said)


@pytest.mark.slow
def test_the_commands_reproduce_the_map_of_the_demo(written, tmp_path, capsys):
    folder, _, _ = written
    again = tmp_path / "again.geojson"
    call = ["map", str(folder / "office.csv"), "--ring", str(folder / "ring.toml"), "-o", str(again)]
    assert cli.main([*call, "--grid", str(tmp_path / "map.yaml")]) == 0
    for mine, name in ((again, "map.geojson"), (tmp_path / "map.pgm", "map.pgm"), (tmp_path / "map.yaml", "map.yaml")):
        assert mine.read_bytes() == (folder / name).read_bytes()
    capsys.readouterr()


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
    again, log = load_log(tmp_path / "again.csv"), load_log(folder / "office.csv")
    heard = np.isfinite(log.range)
    assert len(log.tx) > heard.sum() == again.echo_count == len(again.tx)  # the demo lists what heard nothing, too
    for name in ("tx", "rx", "range", "amplitude"):
        np.testing.assert_array_equal(getattr(again, name), getattr(log, name)[heard])
    np.testing.assert_array_equal(again.echo_scan, log.echo_scan[heard])
    np.testing.assert_array_equal(again.pose, log.pose)
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
