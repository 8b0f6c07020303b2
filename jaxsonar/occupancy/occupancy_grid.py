"""Occupancy grids: which cells are free, occupied or unknown, from echoes, silence and known reflectors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from scipy import ndimage

from jaxsonar import kernels
from jaxsonar.geometry.segments import lengths
from jaxsonar.kernels.shape_buckets import bucket_size, next_power_of_two, pad_rows
from jaxsonar.occupancy.circle_profile import with_confirmed_borders
from jaxsonar.occupancy.echo_arcs import arc_table
from jaxsonar.occupancy.grid_evidence import GridEvidence
from jaxsonar.occupancy.known_reflectors import KnownReflectors, direction_of
from jaxsonar.occupancy.settings import SETTINGS, BayesSettings
from jaxsonar.occupancy.wall_profile import FacingReadings, WallProfile, hidden_walls

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
"""Grey values of map_server's trinary images."""
NO_WALLS = np.zeros((0, 2, 2))
"""No known walls."""


@dataclass(frozen=True, eq=False, repr=False)
class OccupancyGrid:
    """Square cells that are aligned with the world's axes; cell (0, 0) starts at the origin.

    Rows increase with y, columns with x. The arrays are read-only and cropped to what was observed.
    """

    resolution: float
    """Side of a cell, metres."""
    corner: tuple[int, int]
    """First cell of the arrays (column, row), in cells of the world; its x starts at column * resolution."""
    evidence: Float[np.ndarray, "rows columns"]
    """For obstacles: log-odds, or the number of echoes that each cell explains."""
    probability: Float[np.ndarray, "rows columns"]
    """That a cell is occupied; NaN where it was not observed."""
    occupied: Bool[np.ndarray, "rows columns"]
    """Cells of known reflectors and obstacles."""
    free: Bool[np.ndarray, "rows columns"]
    """Cells that are proven to be free, and connected to where the robot drove."""
    looks: Float[np.ndarray, "rows columns"]
    """Number of looks through each cell, weighted by the angle off the axes."""
    footprint: Int[np.ndarray, "rows columns"]
    """Number of scans in which the robot stood on each cell."""
    scans: int = 0
    """Number of scans in the grid."""
    skipped: int = 0
    """Number of scans that were left out because they have no pose."""

    @property
    def origin(self) -> tuple[float, float]:
        """Lower left corner (x, y) of the lower left cell, world frame, metres."""
        return self.corner[0] * self.resolution, self.corner[1] * self.resolution

    def __repr__(self) -> str:
        rows, columns = self.free.shape
        return f"OccupancyGrid({columns} x {rows} cells of {self.resolution:g} m, {self.scans} scans)"

    def classify(self) -> UInt8[np.ndarray, "rows columns"]:
        """The grid as a trinary image of map_server: 0 occupied, 254 free, 205 unknown; row 0 has the largest y."""
        image = np.where(self.occupied, OCCUPIED, np.where(self.free, FREE, UNKNOWN)).astype(np.uint8)
        return image[::-1]


def assemble_grid(
    evidence: GridEvidence,
    profile: WallProfile,
    readings: FacingReadings,
    *,
    parameters: BayesSettings | None = None,
) -> OccupancyGrid:
    """The grid of what was accumulated, with known reflectors drawn into it.

    Args:
        evidence: of all scans.
        profile: known reflectors, and where walls may go on unseen.
        readings: of all scans.
        parameters: of the Bayesian model; those of the evidence's method if omitted.
    """
    area, resolution = evidence.area, evidence.resolution
    if not evidence.looks.size:
        none = np.zeros((0, 0))
        return OccupancyGrid(
            resolution, (0, 0), none, none, none > 0, none > 0, none, none.astype(int), evidence.scans, evidence.skipped
        )
    model: BayesSettings = parameters or getattr(SETTINGS, evidence.method)
    found, viewpoints = _obstacle_evidence(evidence, profile, model)
    robot = (evidence.footprint > 0) | _swept(evidence, readings)
    drawn = with_confirmed_borders(profile.parts, readings, resolution=resolution)
    walls = area.mask(drawn.cells(resolution)) & ~robot
    obstacle = (found > model.occupied) & ~robot
    if evidence.method == "counts":
        obstacle &= viewpoints >= SETTINGS.min_viewpoints
    occupied = walls | obstacle
    # Free: the likely directions of walls are excluded. Walls may go on, unseen, along their extensions.
    share, uniform = _direction_shares(profile.parts.walls)
    needed = SETTINGS.free.min_excluded + SETTINGS.free.irregular * (uniform - SETTINGS.free.uniform)
    free = _excluded_share(evidence.passes, share) >= needed
    between = hidden_walls(profile.parts, _small_obstacles(obstacle, evidence), readings, resolution=resolution)
    hidden = area.mask(KnownReflectors.of_walls(np.concatenate([profile.extensions, between])).cells(resolution))
    beside = np.asarray(ndimage.binary_dilation(occupied | hidden, np.ones((3, 3))), bool)
    unclear = found > SETTINGS.free.max_evidence * model.occupied
    # Thin needles of free cells are single readings: no robot fits there.
    wide = np.asarray(ndimage.binary_opening(free & ~beside & ~unclear | robot, np.ones((3, 3))), bool)
    free = (wide | robot) & ~occupied
    # Free cells that are not connected to where the robot drove are errors, or lie behind an unmapped wall.
    region = np.zeros(free.shape, np.int32)
    ndimage.label(free, output=region)
    free &= np.isin(region, np.unique(region[robot & free]))
    probability = _probability(evidence, model, found, occupied, free)
    return _cropped(evidence, found, probability, occupied, free)


def _obstacle_evidence(
    evidence: GridEvidence, profile: WallProfile, parameters: BayesSettings
) -> tuple[Float[np.ndarray, "rows columns"], Int[np.ndarray, "rows columns"]]:
    """Evidence of obstacles in each cell, and the number of viewpoints from which echoes may come from it."""
    ring, resolution, area = evidence.ring, evidence.resolution, evidence.area
    arcs = evidence.arcs
    walls = profile.parts.walls if evidence.method == "counts" else NO_WALLS
    table = arc_table(ring, arcs, area.corner, area.shape, walls, resolution=resolution)
    seen = table.weight.any(axis=1)
    cell, weight = table.cell[seen], table.weight[seen]
    echoes = np.minimum(arcs.echoes[seen], SETTINGS.max_echoes).astype(np.float32)
    size, cells = bucket_size(len(cell), least=2048), area.shape[0] * area.shape[1]
    padded = next_power_of_two(cells, least=1 << 14)
    looks = evidence.looks.ravel() / 16
    columns = pad_rows(cell, size), pad_rows(weight, size), pad_rows(echoes, size)
    if evidence.method in ("counts", "em"):
        near = np.zeros(padded, np.float32)
        np.add.at(near, cell.ravel(), (weight * echoes[:, None]).ravel())
        near[:cells] = 1 + parameters.missed * looks + SETTINGS.arc_share * near[:cells]
        near[cells:] = 1
        found = kernels.expected_echoes(
            *columns, near, clutter=np.float32(SETTINGS.clutter), cells=padded, rounds=SETTINGS.rounds
        )
    else:
        found = kernels.log_odds(
            *columns,
            pad_rows(looks.astype(np.float32), padded),
            prior=np.float32(parameters.prior),
            detected=np.float32(parameters.detected),
            false=np.float32(parameters.false),
            missed=np.float32(parameters.missed),
            cells=padded,
        )
    viewpoints = np.zeros(cells, np.uint16)
    column, row = np.floor(arcs.pose[seen, :2] / SETTINGS.viewpoint_cell).astype(int).T % 4
    bit = np.broadcast_to((1 << (4 * row + column)).astype(np.uint16)[:, None], cell.shape)
    heard = weight > SETTINGS.min_weight
    np.bitwise_or.at(viewpoints, cell[heard], bit[heard])
    counts = np.bitwise_count(viewpoints).astype(int)
    return np.asarray(found)[:cells].reshape(area.shape), counts.reshape(area.shape)


def _swept(evidence: GridEvidence, readings: FacingReadings) -> Bool[np.ndarray, "rows columns"]:
    """Cells that the robot drove over between two scans: the inscribed circle of its outline, along its way."""
    way = evidence.area.mask(np.floor(readings.driven / evidence.resolution).astype(int))
    outline = evidence.sensors.outline
    # One cell less, because the points of the way are rounded to cells.
    radius = float((-outline[:, 2]).min(initial=np.inf)) / evidence.resolution - 1 if len(outline) else 0.0
    if not 1 <= radius < np.inf:
        return np.zeros_like(way)
    half = int(radius)
    disk = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1]) <= radius
    return np.asarray(ndimage.binary_dilation(way, disk), bool)


def _small_obstacles(
    obstacle: Bool[np.ndarray, "rows columns"], evidence: GridEvidence
) -> Float[np.ndarray, "obstacles 2"]:
    """Centers of obstacles of few cells, metres."""
    region = np.zeros(obstacle.shape, np.int32)
    ndimage.label(obstacle, np.ones((3, 3)), output=region)
    number = np.arange(1, region.max(initial=0) + 1)
    number = number[ndimage.sum_labels(obstacle, region, number) <= SETTINGS.reflectors.small_obstacle]
    center = np.array(ndimage.center_of_mass(obstacle, region, number)).reshape(-1, 2)[:, ::-1]
    return (center + evidence.area.corner + 0.5) * evidence.resolution


def _excluded_share(
    passes: UInt16[np.ndarray, "directions rows columns"], share: Float[np.ndarray, " directions"]
) -> Float[np.ndarray, "rows columns"]:
    """Share of the wall directions that readings exclude in each cell."""
    count = kernels.DIRECTIONS
    excluded = np.zeros(passes.shape[1:], np.float32)
    for k in range(count):
        looks = sum((passes[n % count].astype(np.int32) for n in (k - 1, k, k + 1)), np.int32(0))
        excluded += share[k] * (looks >= SETTINGS.free.min_looks)
    return excluded


def _direction_shares(walls: Float[np.ndarray, "walls 2 2"]) -> tuple[Float[np.ndarray, " directions"], float]:
    """Distribution of the directions of walls: those of the known walls and at right angles to them.

    Also the part of it that is uniform: small if the known walls are at right angles, 1 without any.
    """
    count, uniform = kernels.DIRECTIONS, 1.0
    share = np.full(count, 1.0 / count)
    if len(walls):
        position = direction_of(walls) * (count / np.pi)
        low = np.floor(position).astype(int)
        found = np.zeros(count)
        weight = lengths(walls)
        for turn in (0, count // 2):
            for offset, part in ((0, 1 - (position - low)), (1, position - low)):
                np.add.at(found, (low + offset + turn) % count, part * weight)
        # Where the known walls are not at right angles to each other, unknown walls may have any direction.
        regular = float(np.abs((weight * np.exp(4j * direction_of(walls))).sum()) / weight.sum())
        uniform = max(1 - regular, SETTINGS.free.uniform)
        share = uniform * share + (1 - uniform) * found / found.sum()
    return share, uniform


def _probability(
    evidence: GridEvidence,
    parameters: BayesSettings,
    found: Float[np.ndarray, "rows columns"],
    occupied: Bool[np.ndarray, "rows columns"],
    free: Bool[np.ndarray, "rows columns"],
) -> Float[np.ndarray, "rows columns"]:
    """Probability that a cell is occupied; NaN where nothing was observed."""
    looks = evidence.looks / 16
    if evidence.method in ("counts", "em"):
        # Echoes explained against looks without, with one observation of even odds before any of them.
        probability = (found + 0.5) / (found + 1 + parameters.missed * looks)
    else:
        probability = 1 / (1 + np.exp(-np.clip(found, -30, 30)))
    # Keep a margin to the thresholds, because images have 256 grey values.
    low, high, margin = SETTINGS.free_threshold, SETTINGS.occupied_threshold, SETTINGS.grey_margin
    undecided = np.clip(probability, low + margin, high - margin)
    probability = np.where(occupied, np.maximum(probability, high + margin), undecided)
    probability = np.where(free, np.minimum(probability, low - margin), probability)
    nothing = (looks == 0) & (np.abs(found) < 1e-3) & ~occupied & ~free
    return np.where(nothing, np.nan, probability).astype(np.float32)


def _cropped(
    evidence: GridEvidence,
    found: Float[np.ndarray, "rows columns"],
    probability: Float[np.ndarray, "rows columns"],
    occupied: Bool[np.ndarray, "rows columns"],
    free: Bool[np.ndarray, "rows columns"],
) -> OccupancyGrid:
    """The grid without empty rows and columns at its border."""
    row, column = np.nonzero(~np.isnan(probability))
    rows, columns = (slice(int(k.min()), int(k.max()) + 1) for k in (row, column))
    corner = evidence.area.corner[0] + columns.start, evidence.area.corner[1] + rows.start

    def part(layer: np.ndarray) -> np.ndarray:
        cropped = layer[rows, columns].copy()
        cropped.setflags(write=False)
        return cropped

    return OccupancyGrid(
        resolution=evidence.resolution,
        corner=corner,
        evidence=part(found),
        probability=part(probability),
        occupied=part(occupied),
        free=part(free),
        looks=part(evidence.looks / 16),
        footprint=part(evidence.footprint),
        scans=evidence.scans,
        skipped=evidence.skipped,
    )
