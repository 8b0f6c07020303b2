"""What the README says a reader can run, runs: the Python example and the commands, in the order of the page."""

import contextlib
import json
import re
import shlex
from pathlib import Path

import pytest

from jaxsonar.cli.app import main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, flags=re.DOTALL)


def blocks(language, containing):
    return [text for kind, text in BLOCKS if kind == language and containing in text]


@pytest.fixture(scope="module")
def folder(short_demo):
    """A folder in which the demo has run, with fewer random rooms."""
    return short_demo[0]


def test_the_two_commands_stand_there_once_each():
    setups = blocks("bash", "python3 -m venv .venv && .venv/bin/pip install")
    assert [("bin/jaxsonar demo" in text, "bin/pytest" in text) for text in setups] == [(True, False), (False, True)]


@pytest.mark.slow
def test_the_python_example_runs(folder, capsys):
    (example,) = blocks("python", "import jaxsonar")
    with contextlib.chdir(folder):
        exec(compile(example, "README.md", "exec"), {})
    *walls, world = capsys.readouterr().out.splitlines()
    assert len(walls) == 3
    assert all(wall.startswith("wall 1.") for wall in walls)
    assert world == "8 walls, 10.4 m"


@pytest.mark.slow
def test_the_commands_run(folder):
    pytest.importorskip("pyarrow")
    *elsewhere, commands = blocks("bash", "jaxsonar simulate")
    assert len(elsewhere) == 1
    first, *others = commands.strip().splitlines()
    others += elsewhere[0].strip().splitlines()
    assert first == "jaxsonar demo -o demo"  # which has run, with fewer random rooms
    with contextlib.chdir(folder):
        for command in others:
            program, *arguments = shlex.split(command)
            assert program == "jaxsonar"
            assert main(arguments) == 0, command
        assert {"scans.csv", "scans.parquet", "lines.jsonl", "scan.svg", "map.geojson", "map.pgm"} <= {
            file.name for file in folder.iterdir()
        }


def test_the_table_shows_what_the_demo_measures(folder):
    """The rows of the office, which no random room touches; other builds of JAX may round a vote differently."""
    rows = {row["what"]: row for row in json.loads((folder / "demo" / "table.json").read_text())}
    for what in [what for what in rows if what.startswith("office")]:
        line = next(line for line in README.splitlines() if line.startswith(f"| {what} |"))
        shown = [float(cell) for cell in line.split("|")[2:-2]]
        keys = ("scans", "echoes_per_scan", "walls", "recall", "false_per_scan")
        keys += ("rho_rms_mm", "rho_rms_over_crb", "theta_rms_deg", "theta_rms_over_crb")
        assert shown == pytest.approx([rows[what][key] for key in keys], rel=0.1, abs=0.06), what


def test_the_table_of_maps_shows_what_the_demo_measures(folder):
    keys = ("segments", "false", "walls", "walls_found", "rho_max_mm", "rho_rms_mm", "theta_max_deg", "theta_rms_deg")
    for row in json.loads((folder / "demo" / "map-table.json").read_text()):
        line = next(line for line in README.splitlines() if line.startswith(f"| {row['what']} |"))
        shown = [float(cell) for cell in line.split("|")[2:-1]]
        assert shown == pytest.approx([row[key] for key in keys], rel=0.1, abs=0.06), row["what"]


def test_pictures_and_pages_exist():
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).is_file(), target
