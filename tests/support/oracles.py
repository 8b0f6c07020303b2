"""Slow, readable NumPy versions of the kernels, one loop a sum: what the fast ones are held against."""

import math
from collections import deque

import numpy as np


def wrap(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


def paths(count, neighbors):
    """Echo paths in the documented order, for rings in which no offset leads to the same receiver twice."""
    found = []
    for distance in range(neighbors + 1):
        for offset in [0] if distance == 0 else [distance, -distance]:
            for tx in range(count):
                found.append((tx, (tx + offset) % count))
    return found


def hears(heading, beam, direction):
    """Whether a sensor with this heading and cone hears a far plane in this direction."""
    return abs(wrap(direction - heading)) < beam / 2


def arc_normals(ring, tx, rx, pitch):
    """Normals of the points of one path's arc: the cones' intersection in equal pieces, a point in each middle."""
    turn = wrap(ring.heading[rx] - ring.heading[tx])
    first = max(-ring.beam[tx] / 2, turn - ring.beam[rx] / 2)
    last = min(ring.beam[tx] / 2, turn + ring.beam[rx] / 2)
    if last <= first:
        return []
    pieces = max(1, round((last - first) / pitch))
    return [ring.heading[tx] + first + (k + 0.5) * (last - first) / pieces for k in range(pieces)]


def ellipse_tangent_rho(tx, rx, reach, theta):
    """Distance of the tangent line with normal theta, from the semi-axes of the ellipse (a circle if tx = rx)."""
    middle, half = (tx + rx) / 2, (rx - tx) / 2
    psi = math.atan2(half[1], half[0])
    minor_squared = reach**2 - half @ half
    height = math.sqrt(reach**2 * math.cos(theta - psi) ** 2 + minor_squared * math.sin(theta - psi) ** 2)
    return middle @ np.array([math.cos(theta), math.sin(theta)]) + height


def lines_of_echo(ring, tx, rx, reported, pitch):
    """Tangent lines (rho >= 0, theta) at the points of one echo's arc; none for an echo that does not count."""
    reach = (reported - (ring.range_offset[tx] + ring.range_offset[rx]) / 2) * float(ring.speed_of_sound) / 343.2
    baseline = np.linalg.norm(ring.position[rx] - ring.position[tx])
    if not (reach < ring.max_range and reach > baseline / 2 and reach > 0):
        return []
    lines = []
    for theta in arc_normals(ring, tx, rx, pitch):
        rho = ellipse_tangent_rho(ring.position[tx], ring.position[rx], reach, theta)
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


def beyond(row, column, settings):
    """The cell at (row, column) on the surface of lines: theta wraps, and column -1 is column 0 half a turn on."""
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
                    where = beyond(row + down, column + right, settings)
                    if where is not None:
                        smooth[row, column] += taps[down + half] * taps[right + half] * votes[where]
    return smooth


def full_wall_votes(ring, settings):
    """Paths that hear a plane, averaged over the directions that any path hears, times points an arc has in a cell."""
    listeners = []
    for k in range(7200):
        direction = -math.pi + (k + 0.5) * 2 * math.pi / 7200
        heard = [hears(heading, beam, direction) for heading, beam in zip(ring.heading, ring.beam, strict=True)]
        listeners.append(sum(heard[tx] and heard[rx] for tx, rx in ring.paths))
    covered = [count for count in listeners if count]
    return np.mean(covered) * settings.theta_cell / settings.point_pitch


def components(mask):
    """Sets of cells, 8-connected, joined where theta wraps and across rho = 0, by flood fill."""
    rows = mask.shape[0]
    unseen = {tuple(where) for where in np.argwhere(mask)}
    found = []
    while unseen:
        start = min(unseen)
        unseen.remove(start)
        queue, members = deque([start]), {start}
        while queue:
            row, column = queue.popleft()
            for down in (-1, 0, 1):
                for right in (-1, 0, 1):
                    r, c = row + down, column + right
                    if c < 0:
                        r, c = r + rows // 2, 0
                    where = (r % rows, c)
                    if where in unseen:
                        unseen.remove(where)
                        members.add(where)
                        queue.append(where)
        found.append(frozenset(members))
    return found


def centre_of_gravity(lines):
    """Mean line of (rho, theta) points that lie within a quarter turn of the first one, up to the fold at rho = 0."""
    reference = lines[0][1]
    signed = [
        (rho, theta) if math.cos(theta - reference) >= 0 else (-rho, wrap(theta + math.pi)) for rho, theta in lines
    ]
    rho = sum(rho for rho, _ in signed) / len(signed)
    theta = math.atan2(sum(math.sin(t) for _, t in signed), sum(math.cos(t) for _, t in signed))
    return (rho, theta) if rho >= 0 else (-rho, wrap(theta + math.pi))


def local_model(ring, echoes, settings, level):
    """The paper's section 4 for one scan: echoes (path, reported) to lines (rho, theta, votes, echoes, ends)."""
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
        rho, theta = centre_of_gravity(points)
        n, t = np.array([math.cos(theta), math.sin(theta)]), np.array([-math.sin(theta), math.cos(theta)])
        feet = [ring.position[list(ring.paths[echoes[k][0]])].mean(axis=0) @ t for k in involved]
        ends = np.array([rho * n + min(feet) * t, rho * n + max(feet) * t])
        found.append((rho, theta, len(points), len(involved), ends))
    return sorted(found, key=lambda line: -line[2])


def wall_echoes(ring, rho, theta):
    """Noise-free echoes (path, range) of one infinite wall: image of tx behind it, far cones."""
    n = np.array([math.cos(theta), math.sin(theta)])
    echoes = []
    for k, (tx, rx) in enumerate(ring.paths):
        if hears(ring.heading[tx], ring.beam[tx], theta) and hears(ring.heading[rx], ring.beam[rx], theta):
            image = ring.position[tx] + 2 * (rho - ring.position[tx] @ n) * n
            reach = np.linalg.norm(image - ring.position[rx]) / 2
            if reach < ring.max_range:
                echoes.append((k, reach))
    return echoes


# Windows of the path: poses as 3x3 matrices, scans one after the other.


def matrix(pose):
    """world_from_robot as a homogeneous matrix."""
    x, y, theta = pose
    return np.array([[math.cos(theta), -math.sin(theta), x], [math.sin(theta), math.cos(theta), y], [0, 0, 1]])


def relative(world_from_a, world_from_b):
    """Pose a_from_b: through matrices and back."""
    a_from_b = np.linalg.inv(matrix(world_from_a)) @ matrix(world_from_b)
    return np.array([a_from_b[0, 2], a_from_b[1, 2], math.atan2(a_from_b[1, 0], a_from_b[0, 0])])


def gathered_lines(ring, echoes, last, pitch):
    """Tangent lines of echoes (pose, path, range) in the frame of the pose ``last``: points on arcs in the world first.

    With d half the baseline and b the minor semi-axis, the ellipse is the image of the unit circle under the square
    root of b^2 + d d', and the point with the normal n is m + M n / sqrt(n' M n).
    """
    found = []
    for pose, path, reach in echoes:
        tx, rx = ring.paths[path]
        ends = [(matrix(pose) @ np.append(ring.position[sensor], 1))[:2] for sensor in (tx, rx)]
        middle, half = (ends[0] + ends[1]) / 2, (ends[1] - ends[0]) / 2
        ellipse = (reach**2 - half @ half) * np.eye(2) + np.outer(half, half)
        for direction in arc_normals(ring, tx, rx, pitch):
            n = np.array([math.cos(direction + pose[2]), math.sin(direction + pose[2])])
            point = middle + ellipse @ n / math.sqrt(n @ ellipse @ n)
            point = np.linalg.inv(matrix(last)) @ np.append(point, 1)
            theta = wrap(direction + pose[2] - last[2])
            rho = point[0] * math.cos(theta) + point[1] * math.sin(theta)
            found.append((rho, theta) if rho >= 0 else (-rho, wrap(theta + math.pi)))
    return found


def moved(poses, same_place, same_heading):
    """Of the scans taken in one place the first; places are counted along the path, steps and turns added up."""
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


def renewed(scans):
    """Per scan and reading: whether an even number of scans just before it had the same one."""
    fresh = []
    for k, readings in enumerate(scans):
        fresh.append([])
        for reading in readings:
            before = 0
            while before < k and reading in scans[k - 1 - before]:
                before += 1
            fresh[-1].append(before % 2 == 0)
    return fresh


def windows(poses, length):
    """(first, last) scan of every window: one ends wherever another length/2 is complete, and where poses end."""
    found, begin, way = [], 0, []
    for k, pose in enumerate(poses):
        if not np.isfinite(pose).all():
            begin, way = k + 1, []
            continue
        way.append(way[-1] + math.hypot(*(pose - poses[k - 1])[:2]) if way else 0.0)
        complete = len(way) > 1 and math.floor(way[-1] / (length / 2)) > math.floor(way[-2] / (length / 2))
        if complete or k == len(poses) - 1 or not np.isfinite(poses[k + 1]).all():
            first = min(j for j, gone in enumerate(way) if gone >= way[-1] - length)
            found.append((begin + first, k))
    return found


def window_echoes(scans, poses, span, kept):
    """Kept echoes of one window: (scan, path, range, pose in the frame of the last scan)."""
    first, last = span
    return [
        (k, path, reach, relative(poses[last], poses[k]))
        for k in range(first, last + 1)
        for (path, reach), keep in zip(scans[k], kept[k], strict=True)
        if keep
    ]


# Echoes of a moving robot: (pose, path, range).


def plane_echoes(ring, pose, rho, theta):
    """Noise-free echoes of a wall of the world from one pose."""
    rho = rho - pose[0] * math.cos(theta) - pose[1] * math.sin(theta)
    return [(pose, path, reach) for path, reach in wall_echoes(ring, rho, wrap(theta - pose[2]))]


def point_echoes(ring, pose, place, *, corner):
    """Noise-free echoes of a right-angled corner (tx mirrored twice), or of an edge, of the world from one pose."""
    place = (np.linalg.inv(matrix(pose)) @ np.append(place, 1))[:2]
    echoes = []
    for path, (tx, rx) in enumerate(ring.paths):
        offset = place - (ring.position[tx] + ring.position[rx]) / 2
        bearing = math.atan2(offset[1], offset[0])
        if not (hears(ring.heading[tx], ring.beam[tx], bearing) and hears(ring.heading[rx], ring.beam[rx], bearing)):
            continue
        if corner:
            reach = np.linalg.norm(2 * place - ring.position[tx] - ring.position[rx]) / 2
        else:
            reach = (np.linalg.norm(place - ring.position[tx]) + np.linalg.norm(place - ring.position[rx])) / 2
        if reach < ring.max_range:
            echoes.append((pose, path, reach))
    return echoes
