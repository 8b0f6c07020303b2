"""Run commands of the command line in this process or in a process of its own, and their usual inputs."""

import subprocess
import sys
from pathlib import Path

from jaxsonar.cli import main

DATA = Path(__file__).resolve().parents[2] / "jaxsonar" / "data"

OFFICE, PATH = DATA / "office.geojson", DATA / "office-path.csv"

SIMULATE = ["simulate", OFFICE, "--ring", "faw", "--path", PATH, "--sigma", "0.003", "--seed", "1"]

HEADER = "scan,stamp,x,y,theta,tx,rx,range\n"


def call(*arguments):
    """Run one command in this process. Returns its exit code."""
    try:
        return main([str(argument) for argument in arguments])
    except SystemExit as end:  # raised by argparse
        return end.code


def script(*arguments, **options):
    """Run the installed command in a process of its own."""
    command = [str(Path(sys.executable).parent / "jaxsonar"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def contents(folder):
    """The bytes of all files in a folder, by relative filename."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


RING = """name = 'r'
[ring]
count = 24
radius = 0.28
first_heading_deg = 0
beam_deg = 60
neighbors = 3
max_range = 2
"""


def interrupted_after(models):
    """A replacement of ``local_models`` that yields these models and then raises KeyboardInterrupt."""

    def local_models(*arguments, **options):
        yield from models
        raise KeyboardInterrupt

    return local_models
