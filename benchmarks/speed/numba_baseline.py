"""The paper's section 4 as single-threaded Numba loops: the arithmetic of ``kernels`` in an order that suits a CPU.

Tables and cells are those of ``baselines.FusedPeer``; ranges are (scans, paths, slots), metres, NaN = no echo.
"""

import numpy as np
from numba import njit

MOST_LINES = 32
"""Maximum number of lines of a scan."""


@njit(cache=True, fastmath=False)
def _vote(ranges, tables, cells, votes, cell_of, rho_of, path_of):
    """Votes of ONE scan, and cells and distances of its points for the second pass; returns the number of echoes."""
    along, across2, _, _, row_of, points, half2, offset, _, scale, max_range, _ = tables
    rows, columns, rho_cell = cells
    half_turn = np.int32(rows // 2)
    echo_count = 0
    for path in range(ranges.shape[0]):
        for slot in range(ranges.shape[1]):
            distance = (ranges[path, slot] - offset[path]) * scale
            distance2 = distance * distance
            if not (distance < max_range and distance > 0 and distance2 > half2[path]):  # False for NaN
                continue
            count = points[path]
            m, q, rows_of = along[path, :count], across2[path, :count], row_of[path, :count]
            echo_rho, echo_cell = rho_of[echo_count, :count], cell_of[echo_count, :count]
            for k in range(count):  # this loop is vectorized; the increments below cannot be
                rho = m[k] + np.sqrt(max(distance2 - q[k], np.float32(0)))
                column = np.int32(min(abs(rho) / rho_cell, np.float32(columns)))
                row = rows_of[k] + (half_turn if rho < 0 else np.int32(0))
                row = row - (rows if row >= rows else 0)
                echo_rho[k] = rho
                echo_cell[k] = row * columns + column if column < columns else -1
            for k in range(count):
                if echo_cell[k] >= 0:
                    votes[echo_cell[k]] += 1
            path_of[echo_count] = path
            echo_count += 1
    return echo_count


@njit(cache=True)
def _smooth(votes, rows, columns, level, sums, occupied):
    """Low pass (1, 2, 1 in both directions, across both seams) and threshold of ONE scan; sums are 16 times the mean.

    Single precision and slices that start at 0, so that both inner loops are vectorized.
    """
    two, limit = np.float32(2), np.float32(16) * level
    for row in range(rows):
        up = votes[((row + rows - 1) % rows) * columns :][:columns]
        here, down = votes[row * columns :][:columns], votes[((row + 1) % rows) * columns :][:columns]
        out = sums[row]
        for k in range(columns):
            out[k] = np.float32(up[k]) + two * np.float32(here[k]) + np.float32(down[k])
    for row in range(rows):
        row_sums, high = sums[row], occupied[row]
        before = sums[(row + rows // 2) % rows, 0]  # the cell before rho = 0 is half a turn further
        high[0] = before + two * row_sums[0] + row_sums[1] > limit
        left, middle, right, inner = row_sums[:-2], row_sums[1:-1], row_sums[2:], high[1:-1]
        for k in range(columns - 2):
            inner[k] = left[k] + two * middle[k] + right[k] > limit
        high[columns - 1] = row_sums[columns - 2] + two * row_sums[columns - 1] > limit


@njit(cache=True)
def _label(occupied, rows, columns, labels, stack, first, crossed):
    """Components of ONE scan by flood fill across both seams, numbered from 1 in cell order; returns their number."""
    labels[:] = 0
    count = 0
    high = occupied.reshape(rows * columns)
    for start in range(rows * columns):
        if not high[start] or labels[start]:
            continue
        count += 1
        labels[start], first[count], crossed[count] = count, start // columns, False
        stack[0], top = start, 1
        while top:
            top -= 1
            row, column = stack[top] // columns, stack[top] % columns
            for down in (-1, 0, 1):
                for right in (-1, 0, 1):
                    r, c = row + down, column + right
                    if c >= columns:
                        continue
                    if c < 0:
                        r, c = r + rows // 2, 0
                    r = (r + rows) % rows
                    if not occupied[r, c]:
                        continue
                    if column + right < 0:
                        crossed[count] = True
                    cell = r * columns + c
                    if not labels[cell]:
                        labels[cell] = count
                        stack[top] = cell
                        top += 1
    return count


@njit(cache=True)
def _gather(echo_count, count, tables, cells, cell_of, rho_of, path_of, labels, first, crossed, sums, involved):
    """Sums over the points of each component of ONE scan (number, rho, normal), and the involved echoes."""
    _, _, normal_x, normal_y, _, points, _, _, _, _, _, _ = tables
    rows, columns, _ = cells
    sums[: count + 1] = 0
    involved[: count + 1, :echo_count] = False
    for echo in range(echo_count):
        path = path_of[echo]
        for k in range(points[path]):
            cell = cell_of[echo, k]
            if cell < 0 or labels[cell] == 0:
                continue
            label, rho = labels[cell], rho_of[echo, k]
            sign = np.float32(-1.0 if rho < 0 else 1.0)
            if crossed[label]:
                turn = (cell // columns - first[label] + rows) % rows
                if min(turn, rows - turn) > rows // 4:  # the part of a component beyond rho = 0
                    sign = -sign
            sums[label, 0] += 1
            sums[label, 1] += sign * rho
            sums[label, 2] += sign * normal_x[path, k]
            sums[label, 3] += sign * normal_y[path, k]
            involved[label, echo] = True


@njit(cache=True)
def votes(ranges, tables, cells):
    """Accumulators of a batch."""
    rows, columns, _ = cells
    max_echoes, max_points = ranges.shape[1] * ranges.shape[2], tables[0].shape[1]
    out = np.zeros((len(ranges), rows * columns), np.int32)
    cell_of, rho_of = np.empty((max_echoes, max_points), np.int32), np.empty((max_echoes, max_points), np.float32)
    path_of = np.empty(max_echoes, np.int32)
    for scan in range(len(ranges)):
        _vote(ranges[scan], tables, cells, out[scan], cell_of, rho_of, path_of)
    return out.reshape(len(ranges), rows, columns)


@njit(cache=True)
def occupied(ranges, tables, cells):
    """Occupied cells of a batch."""
    rows, columns, _ = cells
    max_echoes, max_points = ranges.shape[1] * ranges.shape[2], tables[0].shape[1]
    out = np.empty((len(ranges), rows, columns), np.bool_)
    counts, sums = np.empty(rows * columns, np.int32), np.empty((rows, columns), np.float32)
    cell_of, rho_of = np.empty((max_echoes, max_points), np.int32), np.empty((max_echoes, max_points), np.float32)
    path_of = np.empty(max_echoes, np.int32)
    for scan in range(len(ranges)):
        counts[:] = 0
        _vote(ranges[scan], tables, cells, counts, cell_of, rho_of, path_of)
        _smooth(counts, rows, columns, tables[11], sums, out[scan])
    return out


@njit(cache=True)
def lines(ranges, tables, cells, min_echoes):
    """Lines and segments of a batch."""
    rows, columns, _ = cells
    max_echoes, max_points, scans = ranges.shape[1] * ranges.shape[2], tables[0].shape[1], len(ranges)
    sensor = tables[8]
    rho, theta = np.full((scans, MOST_LINES), np.nan), np.full((scans, MOST_LINES), np.nan)
    strength, echoes = np.full((scans, MOST_LINES), np.nan), np.zeros((scans, MOST_LINES), np.int64)
    segments = np.full((scans, MOST_LINES, 2, 2), np.nan)
    counts, sums = np.empty(rows * columns, np.int32), np.empty((rows, columns), np.float32)
    high, labels = np.empty((rows, columns), np.bool_), np.empty(rows * columns, np.int32)
    stack, first = np.empty(rows * columns, np.int32), np.empty(rows * columns // 4 + 2, np.int32)
    crossed = np.empty(rows * columns // 4 + 2, np.bool_)
    cell_of, rho_of = np.empty((max_echoes, max_points), np.int32), np.empty((max_echoes, max_points), np.float32)
    path_of = np.empty(max_echoes, np.int32)
    moments, involved = np.empty((64, 4), np.float32), np.empty((64, max_echoes), np.bool_)
    for scan in range(scans):
        counts[:] = 0
        echo_count = _vote(ranges[scan], tables, cells, counts, cell_of, rho_of, path_of)
        _smooth(counts, rows, columns, tables[11], sums, high)
        count = _label(high, rows, columns, labels, stack, first, crossed)
        if count >= len(moments):
            moments = np.empty((2 * count, 4), np.float32)
            involved = np.empty((2 * count, max_echoes), np.bool_)
        _gather(echo_count, count, tables, cells, cell_of, rho_of, path_of, labels, first, crossed, moments, involved)
        kept = 0
        for label in np.argsort(-moments[1 : count + 1, 0], kind="mergesort") + 1:
            with_point = involved[label, :echo_count].sum()
            if with_point < min_echoes or kept == MOST_LINES:
                continue
            number = moments[label, 0]
            distance, angle = moments[label, 1] / number, np.arctan2(moments[label, 3], moments[label, 2])
            if distance < 0:
                distance, angle = -distance, angle - np.pi if angle > 0 else angle + np.pi
            if angle >= np.pi:
                angle -= 2 * np.pi
            x, y = np.cos(angle), np.sin(angle)
            low, top = np.inf, -np.inf
            for echo in range(echo_count):
                if involved[label, echo]:
                    foot = sensor[path_of[echo], 1] * x - sensor[path_of[echo], 0] * y
                    low, top = min(low, foot), max(top, foot)
            rho[scan, kept], theta[scan, kept], strength[scan, kept] = distance, angle, number
            echoes[scan, kept] = with_point
            segments[scan, kept, 0] = distance * x - low * y, distance * y + low * x
            segments[scan, kept, 1] = distance * x - top * y, distance * y + top * x
            kept += 1
    return rho, theta, strength, echoes, segments
