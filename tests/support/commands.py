"""commands."""

import subprocess
import sys
from pathlib import Path

from jaxsonar.cli import app as cli

DATA = Path(__file__).resolve().parents[2] / "jaxsonar" / "data"

OFFICE, PATH = DATA / "office.geojson", DATA / "office-path.csv"

SIMULATE = ["simulate", OFFICE, "--ring", "faw", "--path", PATH, "--sigma", "0.003", "--seed", "1"]

HEADER = "scan,stamp,x,y,theta,tx,rx,range\n"


def call(*arguments):
    """Exit code of one command, in this process."""
    try:
        return cli.main([str(argument) for argument in arguments])
    except SystemExit as end:  # how argparse ends
        return end.code


def script(*arguments, **options):
    """The installed command, in a process of its own."""
    command = [str(Path(sys.executable).parent / "jaxsonar"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


def contents(folder):
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
    def local_models(*arguments, **options):
        yield from models
        raise KeyboardInterrupt

    return local_models
