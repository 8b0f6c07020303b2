"""``jaxsonar demo`` prints the tables on standard output."""

from pathlib import Path

import numpy as np
from support.hard_cones import simulate

from jaxsonar import LocalModel
from jaxsonar.cli import app as cli
from jaxsonar.demo import run_demo as demo
from jaxsonar.evaluation.line_accuracy import line_accuracy
from jaxsonar.evaluation.map_accuracy import evaluate
from jaxsonar.simulation.office import load_office

SIGMA = 0.003


def test_the_demo_command_prints_the_table(tmp_path, capsys, monkeypatch):
    """With a stub for the computation: tables on standard output, everything else on standard error."""
    rows = []
    some = np.array([[[0.0, 0.0], [1.0, 0.0]]])
    nothing = demo.map_summary(evaluate(np.zeros((0, 2, 2)), some), np.ones(1, dtype=bool), sigma=SIGMA)

    def quick(output, *, seed, on_step, on_room):
        on_step(f"seed {seed}")
        return rows, [{"what": "no map at all", **nothing}]

    empty = load_office()
    heard = simulate(empty.ring, empty.room, empty.poses[:1], sigma=SIGMA)
    rows.append(
        (
            "no line at all",
            line_accuracy(empty.ring, [LocalModel(0, 0.0, ())], heard, empty.room, empty.poses[:1], sigma=SIGMA),
        )
    )
    monkeypatch.setattr(demo, "run_demo", quick)
    assert cli.main(["demo", "-o", str(tmp_path / "d"), "--seed", "7"]) == 0
    came = capsys.readouterr()
    assert "no line at all" in came.out
    assert "no map at all" in came.out
    assert "32.3" in came.out
    assert "7.41" in came.out
    assert "nan" not in came.out
    assert "seed 7" in came.err
    assert not Path(tmp_path / "d").exists()
