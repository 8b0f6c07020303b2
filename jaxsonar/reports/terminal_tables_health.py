"""The health of a ring, as a table for a terminal."""

import math

import numpy as np
from rich.table import Table

from jaxsonar.diagnostics.health_report import Health


def health_table(health: Health) -> Table:
    """One row a sensor, what is the matter with it last; findings about the ring are sentences of their own."""
    table = Table(title=f"Health of {health.ring.name}", caption=_caption(health))
    for column in (
        "sensor",
        "direct\nechoes",
        "cross\nechoes",
        "expected",
        "heard\n(%)",
        "offset\n(mm)",
        "spread\ndirect",
        "all\n(mm)",
        "repeats\n(%)",
        "cone\n(deg)",
        "looks left\nby (deg)",
    ):
        table.add_column(column, justify="right")
    table.add_column("remark")
    for k in range(health.ring.count):
        expected, heard = (int(column[k].sum()) for column in (health.expected, health.heard))
        table.add_row(
            str(k),
            str(health.direct[k]),
            str(health.cross[k]),
            str(expected),
            _shown(100 * heard / expected if expected else math.nan, 0),
            _with_error(1e3 * float(health.offset[k]), 1e3 * float(health.offset_error[k]), digits=1),
            _shown(1e3 * float(health.spread[k, 0]), 1),
            _shown(1e3 * float(health.spread[k, 1]), 1),
            _shown(100 * float(health.repeats[k]), 0),
            _with_error(*np.degrees(health.beam_each[k]).tolist(), digits=0),
            _with_error(*np.degrees(health.centre[k]).tolist(), digits=0),
            health.remarks[k],
            style="bold red" if health.remarks[k] else None,
        )
    return table


def _caption(health: Health) -> str:
    scans = f"{health.scans} scans"
    if health.used < health.scans:
        scans += f", {health.used} of them compared with walls"
    where = {
        "scans": f"{health.walls} walls from single scans",
        "map": f"{health.walls} sightings of a map's walls; residuals hold errors of the poses and delays, too",
        "": health.empty,
    }[health.source]
    width, error = np.degrees(health.beam)
    nominal = math.degrees(health.nominal)
    cone = "not enough to measure the cones" if math.isnan(width) else f"cones {width:.1f} ± {error:.1f} deg wide"
    noise = "" if math.isnan(health.sigma) else f"; noise of the ranges {1e3 * health.sigma:.1f} mm"
    return (
        f"{scans}; {where}{noise}\n{cone}, nominal {nominal:.0f} deg\n"
        "expected, heard: sightings of walls well inside the cones, direct and cross; ±: one standard deviation"
    )


def _with_error(value: float, error: float, *, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f} ± {error:.{digits}f}"


def _shown(value: float, digits: int) -> str:
    return "–" if math.isnan(value) else f"{value:.{digits}f}"
