"""Slow, readable NumPy versions of kernels with one loop for each sum, as oracles of the tests."""

import math
from collections import deque

import numpy as np


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def paths(count, neighbors):
    """Echo paths in the documented order, for rings in which different offsets lead to different receivers."""
    found = []
    for distance in range(neighbors + 1):
        for offset in [0] if distance == 0 else [distance, -distance]:
            for tx in range(count):
                found.append((tx, (tx + offset) % count))
    return found


def receives(heading, beam, direction):
    """Whether a sensor with this heading and cone receives a far plane in this direction."""
    return abs(wrap(direction - heading)) < beam / 2


def arc_normals(ring, tx, rx, pitch):
    """Normals at the points of one path's arc: the middles of equal intervals of the intersection of both cones."""
    turn = wrap(ring.heading[rx] - ring.heading[tx])
    first = max(-ring.beam[tx] / 2, turn - ring.beam[rx] / 2)
    last = min(ring.beam[tx] / 2, turn + ring.beam[rx] / 2)
    if last <= first:
        return []
    pieces = max(1, round((last - first) / pitch))
    return [ring.heading[tx] + first + (k + 0.5) * (last - first) / pieces for k in range(pieces)]


def ellipse_tangent_rho(tx, rx, distance, theta):
    """Distance of the tangent line with normal theta, from the semi-axes of the ellipse (a circle if tx = rx)."""
    middle, half = (tx + rx) / 2, (rx - tx) / 2
    psi = math.atan2(half[1], half[0])
    minor_squared = distance**2 - half @ half
    height = math.sqrt(distance**2 * math.cos(theta - psi) ** 2 + minor_squared * math.sin(theta - psi) ** 2)
    return middle @ np.array([math.cos(theta), math.sin(theta)]) + height


def lines_of_echo(ring, tx, rx, reported, pitch):
    """Tangent lines (rho >= 0, theta) at the points of one echo's arc; an empty list for an invalid echo."""
    distance = (reported - (ring.range_offset[tx] + ring.range_offset[rx]) / 2) * float(ring.speed_of_sound) / 343.2
    baseline = np.linalg.norm(ring.position[rx] - ring.position[tx])
    if not (distance < ring.max_range and distance > baseline / 2 and distance > 0):
        return []
    lines = []
    for theta in arc_normals(ring, tx, rx, pitch):
        rho = ellipse_tangent_rho(ring.position[tx], ring.position[rx], distance, theta)
        lines.append((rho, wrap(theta)) if rho >= 0 else (-rho, wrap(theta + math.pi)))
    return lines


def cell(rho, theta, settings):
    row = int((theta + math.pi) // settings.theta_cell) % settings.theta_cells
    column = int(rho // settings.rho_cell)
    return (row, column) if column < settings.rho_cells else None


def accumulate(cells, settings):
    votes = np.zeros((settings.theta_cells, settings.rho_cells), int)
    for where in cells:
        if where is not None:
            votes[where] += 1
    return votes


def cell_across_seams(row, column, settings):
    """The cell at (row, column): theta wraps, and column -1 is column 0 shifted by half a turn."""
    if column < 0:
        row, column = row + settings.theta_cells // 2, -1 - column
    return (row % settings.theta_cells, column) if column < settings.rho_cells else None


def lowpass(votes, settings):
    taps = np.array(settings.smoothing) / sum(settings.smoothing)
    half = len(taps) // 2
    smooth = np.zeros(votes.shape)
    for row in range(settings.theta_cells):
        for column in range(settings.rho_cells):
            for down in range(-half, half + 1):
                for right in range(-half, half + 1):
                    where = cell_across_seams(row + down, column + right, settings)
                    if where is not None:
                        smooth[row, column] += taps[down + half] * taps[right + half] * votes[where]
    return smooth


def full_wall_votes(ring, settings):
    """Mean number of paths that receive a plane, over all directions with any, times points of an arc per cell."""
    counts = []
    for k in range(7200):
        direction = -math.pi + (k + 0.5) * 2 * math.pi / 7200
        sensors = zip(ring.heading, ring.beam, strict=True)
        receiving = [receives(heading, beam, direction) for heading, beam in sensors]
        counts.append(sum(receiving[tx] and receiving[rx] for tx, rx in ring.paths))
    covered = [count for count in counts if count]
    return np.mean(covered) * settings.theta_cell / settings.point_pitch


def components(mask):
    """8-connected components of cells, also across both seams, by flood fill."""
    rows = mask.shape[0]
    unvisited = {tuple(where) for where in np.argwhere(mask)}
    found = []
    while unvisited:
        start = min(unvisited)
        unvisited.remove(start)
        queue, members = deque([start]), {start}
        while queue:
            row, column = queue.popleft()
            for down in (-1, 0, 1):
                for right in (-1, 0, 1):
                    r, c = row + down, column + right
                    if c < 0:
                        r, c = r + rows // 2, 0
                    where = (r % rows, c)
                    if where in unvisited:
                        unvisited.remove(where)
                        members.add(where)
                        queue.append(where)
        found.append(frozenset(members))
    return found


def mean_line(lines):
    """Mean of lines (rho, theta) within a quarter turn of the first one, in canonical form."""
    reference = lines[0][1]
    signed = [
        (rho, theta) if math.cos(theta - reference) >= 0 else (-rho, wrap(theta + math.pi)) for rho, theta in lines
    ]
    rho = sum(rho for rho, _ in signed) / len(signed)
    theta = math.atan2(sum(math.sin(t) for _, t in signed), sum(math.cos(t) for _, t in signed))
    return (rho, theta) if rho >= 0 else (-rho, wrap(theta + math.pi))


def hough_lines(ring, echoes, settings, level):
    """The paper's section 4 for one scan: from echoes (path, reported) to (rho, theta, votes, echoes, endpoints)."""
    per_echo = []
    for path, reported in echoes:
        tx, rx = ring.paths[path]
        lines = lines_of_echo(ring, tx, rx, reported, settings.point_pitch)
        per_echo.append([((rho, theta), cell(rho, theta, settings)) for rho, theta in lines])
    votes = accumulate([where for lines in per_echo for _, where in lines], settings)
    mask = lowpass(votes, settings) > level
    found = []
    for members in components(mask):
        points = [line for lines in per_echo for line, where in lines if where in members]
        involved = [k for k, lines in enumerate(per_echo) if any(where in members for _, where in lines)]
        if len(involved) < settings.min_echoes:
            continue
        rho, theta = mean_line(points)
        n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
        footpoints = [ring.position[list(ring.paths[echoes[k][0]])].mean(axis=0) @ t for k in involved]
        ends = np.array([rho * n + min(footpoints) * t, rho * n + max(footpoints) * t])
        found.append((rho, theta, len(points), len(involved), ends))
    return sorted(found, key=lambda line: -line[2])


def echoes_of_wall(ring, rho, theta):
    """Noise-free echoes (path, range) of one infinite wall, by the image source and far-field cones."""
    n = np.array([math.cos(theta), math.sin(theta)])
    echoes = []
    for k, (tx, rx) in enumerate(ring.paths):
        if receives(ring.heading[tx], ring.beam[tx], theta) and receives(ring.heading[rx], ring.beam[rx], theta):
            image = ring.position[tx] + 2 * (rho - ring.position[tx] @ n) * n
            distance = np.linalg.norm(image - ring.position[rx]) / 2
            if distance < ring.max_range:
                echoes.append((k, distance))
    return echoes


# Windows of the trajectory: poses as 3x3 matrices, scans in a loop.


def matrix(pose):
    """world_from_robot as a homogeneous matrix."""
    x, y, theta = pose
    return np.array([[math.cos(theta), -math.sin(theta), x], [math.sin(theta), math.cos(theta), y], [0, 0, 1]])


def relative(world_from_a, world_from_b):
    """Pose a_from_b, computed with matrices."""
    a_from_b = np.linalg.inv(matrix(world_from_a)) @ matrix(world_from_b)
    return np.array([a_from_b[0, 2], a_from_b[1, 2], math.atan2(a_from_b[1, 0], a_from_b[0, 0])])


def tangent_lines_in_frame(ring, echoes, last, pitch):
    """Tangent lines of echoes (pose, path, range) in the frame of the pose ``last``, from points of arcs in the world.

    With half the baseline d, the minor semi-axis b and M = b^2 + d d', the point of the ellipse with the normal n is
    m + M n / sqrt(n' M n).
    """
    found = []
    for pose, path, distance in echoes:
        tx, rx = ring.paths[path]
        ends = [(matrix(pose) @ np.append(ring.position[sensor], 1))[:2] for sensor in (tx, rx)]
        middle, half = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
        ellipse = (distance**2 - half @ half) * np.eye(2) + np.outer(half, half)
        for direction in arc_normals(ring, tx, rx, pitch):
            n = np.array([math.cos(direction + pose[2]), math.sin(direction + pose[2])])
            point = middle + ellipse @ n / math.sqrt(n @ ellipse @ n)
            point = np.linalg.inv(matrix(last)) @ np.append(point, 1)
            theta = wrap(direction + pose[2] - last[2])
            rho = point[0] * math.cos(theta) + point[1] * math.sin(theta)
            found.append((rho, theta) if rho >= 0 else (-rho, wrap(theta + math.pi)))
    return found


def is_first_at_place(poses, same_place, same_heading):
    """Whether each scan is the first at its place; places are counted along the trajectory by distance and rotation."""
    first, place = [], 0.0
    for k, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            first.append(False)
        elif k == 0 or not np.isfinite(poses[k - 1]).all():
            first.append(True)
        else:
            before, step = math.floor(place), pose - poses[k - 1]
            place += math.hypot(step[0], step[1]) / same_place + abs(wrap(step[2])) / same_heading
            first.append(math.floor(place) > before)
    return first


def is_fresh(scans):
    """Whether an even number of consecutive earlier scans have the same reading; for each reading of each scan."""
    fresh = []
    for k, readings in enumerate(scans):
        fresh.append([])
        for reading in readings:
            before = 0
            while before < k and reading in scans[k - 1 - before]:
                before += 1
            fresh[-1].append(before % 2 == 0)
    return fresh


def window_spans(poses, length):
    """(first, last) scan of every window; a window ends after each length/2 and where the poses end."""
    found, begin, travelled = [], 0, []
    for k, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            begin, travelled = k + 1, []
            continue
        travelled.append(travelled[-1] + math.hypot(*(pose - poses[k - 1])[:2]) if travelled else 0.0)
        complete = len(travelled) > 1 and math.floor(travelled[-1] / (length / 2)) > math.floor(
            travelled[-2] / (length / 2)
        )
        if complete or k == len(poses) - 1 or not np.isfinite(poses[k + 1]).all():
            first = min(j for j, distance in enumerate(travelled) if distance >= travelled[-1] - length)
            found.append((begin + first, k))
    return found


def window_echoes(scans, poses, span, kept):
    """Kept echoes of one window: (scan, path, range, pose in the frame of the last scan)."""
    first, last = span
    return [
        (k, path, distance, relative(poses[last], poses[k]))
        for k in range(first, last + 1)
        for (path, distance), keep in zip(scans[k], kept[k], strict=True)
        if keep
    ]


# Echoes of a moving robot: (pose, path, range).


def plane_echoes(ring, pose, rho, theta):
    """Noise-free echoes (pose, path, range) of a wall of the world."""
    rho = rho - pose[0] * math.cos(theta) - pose[1] * math.sin(theta)
    return [(pose, path, distance) for path, distance in echoes_of_wall(ring, rho, wrap(theta - pose[2]))]


def point_echoes(ring, pose, place, *, corner):
    """Noise-free echoes (pose, path, range) of a right-angled corner (tx mirrored twice) or an edge of the world."""
    place = (np.linalg.inv(matrix(pose)) @ np.append(place, 1))[:2]
    echoes = []
    for path, (tx, rx) in enumerate(ring.paths):
        offset = place - (ring.position[tx] + ring.position[rx]) / 2
        bearing = math.atan2(offset[1], offset[0])
        if not (
            receives(ring.heading[tx], ring.beam[tx], bearing) and receives(ring.heading[rx], ring.beam[rx], bearing)
        ):
            continue
        if corner:
            distance = np.linalg.norm(2 * place - ring.position[tx] - ring.position[rx]) / 2
        else:
            distance = (np.linalg.norm(place - ring.position[tx]) + np.linalg.norm(place - ring.position[rx])) / 2
        if distance < ring.max_range:
            echoes.append((pose, path, distance))
    return echoes


# Circles


def shortest_path_over_circle(circle, tx, rx):
    """Lengths of the shortest paths tx -> point of the circle -> rx: a grid over the circle, then golden sections.

    Args:
        circle: (n, 3) center and radius, metres.
        tx: (n, 2) transmitters.
        rx: (n, 2) receivers.
    """

    def length(angle):
        point = circle[:, :2] + circle[:, 2:] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.linalg.norm(point - tx, axis=-1) + np.linalg.norm(point - rx, axis=-1)

    grid = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    best = grid[np.argmin([length(np.full(len(circle), angle)) for angle in grid], axis=0)]
    low, high, golden = best - grid[1], best + grid[1], (math.sqrt(5) - 1) / 2
    for _ in range(50):
        left, right = high - golden * (high - low), low + golden * (high - low)
        lower = length(left) < length(right)
        low, high = np.where(lower, low, left), np.where(lower, right, high)
    return length((low + high) / 2)
