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
        listeners.append(
            sum(
                hears(ring.heading[tx], ring.beam[tx], direction) and hears(ring.heading[rx], ring.beam[rx], direction)
                for tx, rx in ring.paths
            )
        )
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
