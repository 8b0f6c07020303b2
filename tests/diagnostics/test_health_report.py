"""The result of the health check as JSON, as a table and as a figure."""

import numpy as np
import pytest
from rich.console import Console
from support.health_logs import RING, written

from jaxsonar.reports import plot_style
from jaxsonar.reports.plot_health import health_figure
from jaxsonar.reports.terminal_tables import health_table


@pytest.mark.slow
def test_json_table_and_figure(healthy, tmp_path):
    plain = written(healthy)
    assert plain["ring"] == RING.name
    assert len(plain["offset"]) == 24
    assert {"heard", "centre", "fits", "answered"} <= set(plain)  # keys of the file format
    np.testing.assert_allclose(plain["nominal_beam"], np.pi / 3)
    with open(tmp_path / "table.txt", "w", encoding="utf-8") as file:
        Console(file=file, width=160).print(health_table(healthy))
    assert "Health of ring" in (tmp_path / "table.txt").read_text(encoding="utf-8")
    plot_style.save_figure(health_figure(healthy), tmp_path / "health.svg")
    assert (tmp_path / "health.svg").stat().st_size > 10_000
