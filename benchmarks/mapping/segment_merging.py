"""Merging of segments to walls: time, memory and scaling of all methods, on buildings of growing floor area.

Run ``python -m benchmarks.mapping.segment_merging``. Each measurement runs in a process of its own. Compare only ratios
between machines.
"""

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import sys
import time

import jax
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import KDTree

from jaxsonar.geometry.se2 import wrap_angle
from jaxsonar.mapping.hough_merging import merge_by_hough, single_linkage
from jaxsonar.mapping.observations import merge_cells
from jaxsonar.mapping.segment_fusion import fuse_segments
from jaxsonar.mapping.settings import SETTINGS
from jaxsonar.mapping.wall_segments import WallSegments

ROOM = np.array([6.0, 4.0])
"""Size of a room, metres."""
WALL_THICKNESS = 0.6
"""Distance between rooms, metres: above the linkage distance, so that rooms are clusters, the best case."""
SEGMENTS_PER_WALL = 30
"""Segments per wall."""
CLUTTER = 0.1
"""Share of the segments without a wall."""
GAP, CUT = 0.5, 0.4
"""Maximum gap within a wall, and linkage distance, metres."""
NEAR, NEAR_ANGLE = 0.1, math.radians(5.0)
"""Gates between a found and a true wall, metres and radians."""
METHODS = ("merge_cells + fuse_segments", "merge_by_hough", "single_linkage", "scipy linkage(single)")
MAX_SCIPY_SEGMENTS = 10_000
"""Maximum number of segments for SciPy, which stores n^2 / 2 distances (0.4 GB for these)."""


def building(
    segments: int, *, wall_thickness: float = WALL_THICKNESS, seed: int = 0
) -> tuple[WallSegments, np.ndarray]:
    """Segments of local models in a square of rooms, and the true walls (walls, 2, 2)."""
    rng = np.random.default_rng(seed)
    clutter = int(CLUTTER * segments)
    rooms = max(1, round((segments - clutter) / (4 * SEGMENTS_PER_WALL)))
    rooms_per_row = math.ceil(math.sqrt(rooms))
    corner = np.stack([np.arange(rooms) % rooms_per_row, np.arange(rooms) // rooms_per_row], axis=-1) * (
        ROOM + wall_thickness
    )
    around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * ROOM
    walls = (corner[:, None, None] + np.stack([around, np.roll(around, -1, axis=0)], axis=1)).reshape(-1, 2, 2)
    wall = rng.integers(0, len(walls), segments - clutter)
    along = (walls[wall, 1] - walls[wall, 0]) / np.linalg.norm(walls[wall, 1] - walls[wall, 0], axis=-1)[:, None]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    length = rng.uniform(0.3, 0.6, segments)
    size = np.linalg.norm(walls[wall, 1] - walls[wall, 0], axis=-1)
    wall_length = length[: len(wall)]
    place = wall_length / 2 + rng.random(len(wall)) * (size - wall_length)
    center = (
        walls[wall, 0]
        + place[:, None] * along
        + rng.normal(0, SETTINGS.segments.offset_sd, len(wall))[:, None] * normal
    )
    theta = np.arctan2(normal[:, 1], normal[:, 0]) + rng.normal(0, SETTINGS.segments.theta_sd, len(wall))
    center = np.concatenate([center, rng.uniform(0, 1, (clutter, 2)) * (corner.max(axis=0) + ROOM)])
    theta = np.concatenate([theta, rng.uniform(-np.pi, np.pi, clutter)])
    order = rng.permutation(segments)
    row = np.arange(segments)
    observed = WallSegments(
        center=center[order],
        theta=wrap_angle(theta[order]),
        extent=0.5 * length[order, None] * np.array([-1.0, 1.0]),
        info_offset=np.full(segments, SETTINGS.segments.offset_sd**-2),
        info_theta=np.full(segments, SETTINGS.segments.theta_sd**-2),
        chi_squared=np.zeros(segments),
        count=np.ones(segments, np.int64),
        echoes=np.full(segments, 6),
        viewing_distance=rng.uniform(0.5, 4, segments),
        last_seen=row / 10,
        scans=(row, row // 4),
    )
    return observed, walls


def true_walls_found(observed: WallSegments, walls: np.ndarray) -> int:
    """Number of true walls that one found wall covers."""
    long = observed.take(observed.length > 1.0)
    if not len(long):
        return 0
    along = walls[:, 1] - walls[:, 0]
    size = np.linalg.norm(along, axis=-1)
    near = KDTree(long.center).query_ball_point(walls.mean(axis=1), 0.3 * float(ROOM.max()))
    found = 0
    for k, rows in enumerate(near):
        rows_near = np.asarray(rows, dtype=np.int64)
        across = np.abs(((long.center[rows_near] - walls[k, 0]) * [along[k, 1], -along[k, 0]]).sum(-1)) / size[k]
        turn = np.abs(np.sin(long.theta[rows_near] - math.atan2(-along[k, 0], along[k, 1])))
        covers = np.abs(long.length[rows_near] / size[k] - 1) < 0.3
        found += bool(((across < NEAR) & (turn < math.sin(NEAR_ANGLE)) & covers).any())
    return found


def peak() -> float:
    """Peak resident memory of this process, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(method: str, segments: int, wall_thickness: float) -> dict[str, float | str]:
    """Measure one method on one building: seconds, MB without the segments, walls found."""
    small, _ = building(1000)
    observed, walls = building(segments, wall_thickness=wall_thickness)
    midpoint = observed.endpoints.mean(axis=1)
    runs = {
        "merge_cells + fuse_segments": lambda observed: fuse_segments(merge_cells(observed), gap=GAP)[0],
        "merge_by_hough": lambda observed: merge_by_hough(observed, linkage_distance=CUT),
        "single_linkage": lambda observed: single_linkage(midpoint[: len(observed)], CUT),
        "scipy linkage(single)": lambda observed: fcluster(
            linkage(midpoint[: len(observed)], "single"), CUT, "distance"
        ),
    }
    runs[method](small)  # warm-up: imports and the common compilations
    before, start = peak(), time.perf_counter()
    try:
        found = runs[method](observed)
    except (ValueError, MemoryError) as failure:
        return {"failure": f"{type(failure).__name__}: {failure}"}
    result: dict[str, float | str] = {"seconds": time.perf_counter() - start, "memory": peak() - before}
    result["true"] = len(walls)
    if isinstance(found, WallSegments):
        result |= {
            "found": true_walls_found(found, walls),
            "walls": len(found),
            "confirmed": int((found.count > 4).sum()),
        }
    else:
        result["walls"] = len(np.unique(found))
    return result


def in_a_process(method: str, segments: int, wall_thickness: float, limit: float) -> dict[str, float | str]:
    """``measure`` in a process of its own, so that its peak memory is separate."""
    call = [
        sys.executable,
        "-m",
        "benchmarks.mapping.segment_merging",
        "--one",
        method,
        str(segments),
        str(wall_thickness),
    ]
    try:
        done = subprocess.run(call, capture_output=True, text=True, timeout=limit)
    except subprocess.TimeoutExpired:
        return {"failure": f"more than {limit:g} s"}
    if done.returncode:
        return {"failure": f"exit {done.returncode}: {done.stderr.strip().splitlines()[-1:]}"}
    return json.loads(done.stdout.splitlines()[-1])


def growth(one: tuple[int, float], other: tuple[int, float]) -> float:
    """The exponent p of n^p between two measurements (n, value)."""
    return math.log(other[1] / one[1]) / math.log(other[0] / one[0])


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true", help="1e3 and 1e4 segments instead of 1e4, 1e5 and 1e6")
    options.add_argument("--thick", type=float, default=WALL_THICKNESS, help="metres between rooms")
    options.add_argument("--limit", type=float, default=600.0, help="seconds for each measurement")
    options.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    options = options.parse_args()
    if options.one:
        method, segments, wall_thickness = options.one
        print(json.dumps(measure(method, int(segments), float(wall_thickness))))
        return
    sizes = (1_000, 10_000) if options.quick else (10_000, 100_000, 1_000_000)
    table = Table(
        title=f"Segments of rooms of {ROOM[0]:g} m x {ROOM[1]:g} m, {options.thick:g} m apart; "
        f"{SEGMENTS_PER_WALL} per wall, {CLUTTER:.0%} clutter; gap {GAP} m, linkage distance {CUT} m",
        caption="memory: growth of the largest resident set (ru_maxrss); growth: p of n^p from the row above, in "
        f"brackets that of n log n; of > 4: walls with more than 4 segments. numpy {np.__version__}, "
        f"jax {jax.__version__} on {jax.devices()[0].device_kind}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}",
    )
    for column in ("", "segments", "s", "us/seg.", "growth", "MB", "walls true", "found", "made", "of > 4", "x fuse"):
        table.add_column(column, justify="left" if not column else "right")
    whole: dict[int, float] = {}
    for method in METHODS:
        last: tuple[int, float] | None = None
        for size in sizes:
            if method.startswith("scipy") and size > MAX_SCIPY_SEGMENTS:
                continue
            found = in_a_process(method, size, options.thick, options.limit)
            if "failure" in found:
                table.add_row(method, f"{size:,}", str(found["failure"]))
                continue
            seconds = float(found["seconds"])
            if method == METHODS[0]:
                whole[size] = seconds
            nlogn = growth((last[0], last[0] * math.log(last[0])), (size, size * math.log(size))) if last else 0
            table.add_row(
                method,
                f"{size:,}",
                f"{seconds:.2f}",
                f"{seconds / size * 1e6:.1f}",
                f"{growth(last, (size, seconds)):.2f} ({nlogn:.2f})" if last else "",
                f"{found['memory']:.0f}",
                *(f"{found[name]:,}" if name in found else "" for name in ("true", "found", "walls", "confirmed")),
                f"{seconds / whole[size]:.2f}" if size in whole else "",
            )
            last = (size, seconds)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
