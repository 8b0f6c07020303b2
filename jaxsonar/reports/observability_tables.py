"""What a ring is, in sentences, and what it can observe, as tables for a terminal."""

import math

import numpy as np
from rich.table import Table

from jaxsonar import kernels
from jaxsonar.observability.reflectors import NAME_OF_KIND, THREE_KINDS
from jaxsonar.observability.ring_bounds import DistanceBounds, RingBounds
from jaxsonar.reports.text import NO_VALUE, fixed, plural
from jaxsonar.sensors.ring import Ring

POINTS = tuple(NAME_OF_KIND[kind] for kind in (kernels.CORNER, kernels.EDGE))


def scan_time(ring: Ring) -> float:
    """Shortest time of a scan, seconds: each firing group waits for echoes from the maximum range."""
    return len(ring.firing_groups) * 2 * ring.max_range / float(ring.speed_of_sound)


def ring_lines(ring: Ring) -> list[str]:
    """Sensors, cones, paths and firing groups of a ring, one sentence a line."""
    position, beam = np.asarray(ring.position, np.float64), np.degrees(np.asarray(ring.beam, np.float64))
    paths, groups = ring.paths, ring.firing_groups
    direct = int((paths[:, 0] == paths[:, 1]).sum())
    size = np.ptp(position, axis=0)
    cones = f"{beam.min():g} deg" if beam.min() == beam.max() else f"{beam.min():g} to {beam.max():g} deg"
    sizes = sorted({len(group) for group in groups}, reverse=True)
    largest = str(sizes[0]) if len(sizes) == 1 else f"{sizes[-1]} to {sizes[0]}"
    arrangement = "in a closed ring" if ring.closed else "in an open array"
    return [
        f"{ring.name}: {plural(ring.count, 'sensor')} {arrangement}, {1e3 * size[0]:.0f} x {1e3 * size[1]:.0f} mm",
        f"cones {cones}, echoes up to {ring.max_range:g} m, speed of sound {float(ring.speed_of_sound):g} m/s",
        f"{plural(len(paths), 'echo path')}: {direct} direct, {len(paths) - direct} cross "
        f"(up to neighbor {ring.neighbors})",
        f"{plural(len(groups), 'firing group')} of {largest}; a scan takes {1e3 * scan_time(ring):.0f} ms or more",
    ]


def bounds_table(bounds: RingBounds, what: str) -> Table:
    """Bounds and error rates over distance.

    Args:
        bounds: of a ring.
        what: "shot" or "scan".
    """
    rows: tuple[DistanceBounds, ...] = getattr(bounds, what)
    shot = f"one shot of sensor {bounds.transmitter}"
    title = shot if what == "shot" else "one scan (or one shot of coded transmitters)"
    table = Table(
        title=f"What {title} can observe, range noise sigma = {1e3 * bounds.sigma:g} mm",
        caption="Cramer-Rao bounds of distance and direction, for corners and edges across the line of sight, and of "
        "the radius r of\ncircles; they are proportional to sigma. Wrong kind: error rate of maximum likelihood "
        "between wall, corner\nand edge, and with circles (guessing: 67 and 75 %). –: not observable",
    )
    radii = rows[0].radius_sd
    headings = [
        "surface\nat (m)", "echoes\nof a wall", "wall\n(mm)", "wall\n(deg)",
        "corner\n(mm)", "across\n(mm)", "edge\n(mm)", "across\n(mm)",
        *(f"r {1e3 * radius:g}\n(mm)" for radius in radii),
        "wrong kind\n(%)", "with\ncircles (%)",
    ]  # fmt: skip
    for heading in headings:
        table.add_column(heading, justify="right")
    plane = NAME_OF_KIND[THREE_KINDS[0]]
    for row in rows:
        cells = [f"{row.distance:g}", fixed(row.echoes[plane], 0)]
        cells += [_cell(1e3 * row.range_sd[plane]), _cell(math.degrees(row.bearing_sd[plane]))]
        for kind in POINTS:
            cells += [_cell(1e3 * row.range_sd[kind]), _cell(1e3 * row.distance * row.bearing_sd[kind])]
        cells += [_cell(1e3 * value) for value in row.radius_sd.values()]
        cells += [_cell(100 * row.three_kinds_error, 1), _cell(100 * row.four_kinds_error, 1)]
        table.add_row(*cells)
    return table


def _cell(value: float, digits: int | None = None) -> str:
    """A number with two figures or more; a dash where nothing is known."""
    if not math.isfinite(value):
        return NO_VALUE
    return f"{value:.{digits if digits is not None else 3 if value < 0.1 else 2 if value < 10 else 0}f}"
