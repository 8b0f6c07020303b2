"""Reference walls around the robot from short pieces of its trajectory, for rings that see few walls in one scan."""

import numpy as np
from jaxtyping import Int

from jaxsonar import kernels
from jaxsonar.diagnostics.reference_scene import ReferenceScene, empty_scene, evenly_spaced
from jaxsonar.diagnostics.settings import SETTINGS
from jaxsonar.geometry.se2 import rotate, tangent_of, unit
from jaxsonar.plausibility.pose_agreement import select_groups
from jaxsonar.registration.local_reflectors import find_reflectors, group_echoes
from jaxsonar.scans.scan_log import Log
from jaxsonar.scans.sliding_windows import has_moved
from jaxsonar.sensors.range_models import plane_footpoint
from jaxsonar.sensors.ring import Ring


def groups_of_scans(log: Log, groups_of_piece: int = SETTINGS.reference.piece_groups[0]) -> list[Int[np.ndarray, "_"]]:
    """Rows of the scans of each piece of the trajectory.

    Pieces are several times as long as the groups of ``select_groups``, so that different sensors see the same walls,
    and contain the scans in between.

    Args:
        log: the scans.
        groups_of_piece: largest number of groups of ``select_groups`` that make a piece.
    """
    moved, settings = has_moved(log.pose), SETTINGS.reference
    selected = select_groups(log)
    groups, first = [], 0
    while first < len(selected):
        after = first + 1  # the piece goes on while the groups are neighbors
        while after < min(len(selected), first + groups_of_piece):
            before = selected[after - 1]
            if selected[after][0] - before[-1] > 2 * np.diff(before).max():
                break
            after += 1
        begin, last = int(selected[first][0]), int(selected[after - 1][-1])
        if after == first + 1:  # alone: scans behind it, up to the next group
            end = len(log) if after == len(selected) else int(selected[after][0])
            last = min(2 * last - begin, end - 1)
        rows = begin + np.flatnonzero(moved[begin : last + 1])
        groups.append(rows[evenly_spaced(len(rows), settings.scans_of_group * groups_of_piece)])
        first = after
    return groups


def scene_from_groups(ring: Ring, log: Log, *, long: bool | None = None) -> ReferenceScene:
    """The reflectors that several scans of a piece of the trajectory support, in the robot frame of each of them.

    Args:
        ring: the sensors.
        log: scans with poses; the others have no reflectors.
        long: whether pieces are long; None if the sensors do not hear their neighbors.
    """
    settings = SETTINGS.reference
    long = not ring.neighbors if long is None else long
    groups = groups_of_scans(log, settings.piece_groups[long])
    echoes = group_echoes(ring, log, groups)
    found = find_reflectors(echoes, echoes.pose, settings.walls_of_piece[long])
    if not len(found.kind):
        return empty_scene(ring, len(log))
    tx, rx = ring.paths[echoes.path[found.echo]].T
    of_sensor = np.zeros((len(found.kind), ring.count), np.int64)
    np.add.at(of_sensor, (found.reflector, tx), 1)
    np.add.at(of_sensor, (found.reflector, rx), tx != rx)
    count = np.bincount(found.reflector, minlength=len(found.kind))
    # The extent of each wall: where it reflected the sound.
    is_wall = found.kind == kernels.PLANE
    midpoint, baseline = echoes.geometry(echoes.pose[found.echo], echoes.path[found.echo])
    along = plane_footpoint(found.parameters[found.reflector], midpoint, baseline, min_height=1e-3)
    start, end = np.full(len(found.kind), np.inf), np.full(len(found.kind), -np.inf)
    np.minimum.at(start, found.reflector, along)
    np.maximum.at(end, found.reflector, along)
    extent = np.stack([start, end], axis=-1)
    # The reflectors of each scan are those of its group, in its own frame.
    group_of_scan, origin = np.full(len(log), -1), np.zeros((len(log), 2))
    for number, rows in enumerate(groups):
        group_of_scan[rows], origin[rows] = number, np.median(log.pose[rows, :2], axis=0)  # as in group_echoes
    group_of_reflector = np.full(len(found.kind), -1)
    group_of_reflector[found.reflector] = group_of_scan[echoes.scan[found.echo]]
    rank = np.arange(len(found.kind)) - np.searchsorted(group_of_reflector, group_of_reflector)
    reflector = np.full((len(groups) + 1, max(settings.walls_of_piece)), -1)
    reflector[group_of_reflector, rank] = np.arange(len(found.kind))
    reflector = reflector[group_of_scan]  # the last row, of scans without a group, is empty
    exists, pose = reflector >= 0, log.pose - np.pad(origin, ((0, 0), (0, 1)))
    pose = np.where(np.any(exists, axis=1, keepdims=True), pose, 0.0)
    wall = exists & is_wall[reflector]
    plane = found.parameters[reflector]
    theta = plane[..., 1] - pose[:, None, 2]
    rho = plane[..., 0] - (pose[:, None, :2] * unit(plane[..., 1])).sum(axis=-1)
    shift = (pose[:, None, :2] * tangent_of(plane[..., 1])).sum(axis=-1)
    point = rotate(plane - pose[:, None, :2], -pose[:, None, 2])
    exists &= ~wall | (rho > 0)  # not walls behind the robot
    return ReferenceScene(
        kind=np.where(exists, found.kind[reflector], -1),
        parameters=np.where(wall[..., None], np.stack([rho, theta], axis=-1), point),
        is_wall=wall & exists,
        extent=extent[reflector] - shift[..., None],
        echoes=count[reflector] * exists,
        echoes_of_sensor=of_sensor[reflector] * exists[..., None],
        sigma=np.full(len(log), np.nan),
        number=reflector,
        shift=shift,
        by_poses=True,
    )
