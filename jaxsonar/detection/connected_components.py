"""Regions of cohesive occupied cells, by OpenCV: the one file that imports cv2 (paper, section 4)."""

import cv2
import numpy as np
from jaxtyping import Bool, Int


def label_components(
    occupied: Bool[np.ndarray, "scans theta rho"],
) -> tuple[Int[np.ndarray, "scans theta_and_one rho"], Int[np.ndarray, " scans"]]:
    """8-connected components of the accumulators of a batch of scans, joined across both seams of the plane of lines.

    The first and the last row touch, because theta wraps; cells of the first column touch those half a turn further,
    because (-rho, theta) is the line (rho, theta + pi). All scans go through OpenCV as one image, of runs of empty rows
    one each: few cells are occupied.

    Args:
        occupied: highly occupied cells, rows theta, columns rho.

    Returns:
        labels: 0 for no component, else k or -k for component k of that scan, counted from 1 in the order of cells.
            Minus marks the far side of a component that joined across rho = 0: cells more than a quarter turn from its
            first cell. After the last row comes an empty one: the points of no cell have the index of its first cell.
        counts: number of components of each scan.
    """
    scans, rows, columns = occupied.shape
    cell = np.flatnonzero(occupied)
    cell += cell // (rows * columns) * columns  # among the labels, which have a row more
    row, column = np.divmod(cell, columns)
    place = np.full(len(cell), 2)
    np.minimum(row[1:] - row[:-1], 2, out=place[1:])
    place = np.cumsum(place)
    image = np.zeros((int(place[-1]) + 1 if len(place) else 1, columns), np.uint8)
    image[place, column] = 1
    small, kind = (np.int16, cv2.CV_16U) if len(cell) < 1 << 15 else (np.int32, cv2.CV_32S)
    total, parts = cv2.connectedComponentsWithAlgorithm(image, 8, kind, cv2.CCL_BBDT)  # the fastest here
    labels = np.zeros((scans, rows + 1, columns), small)
    labels.ravel()[cell] = parts[place, column]

    theta_seam = _touching(labels[:, 0], labels[:, rows - 1], wrap=False)
    edge, half = labels[:, :rows, 0], rows // 2
    rho_seam = _touching(edge, np.concatenate([edge[:, half:], edge[:, :half]], axis=1), wrap=True)
    # From parts, as OpenCV numbers them, to components, and back to their cells.
    component_of = _joined(np.concatenate([theta_seam, rho_seam], axis=1), total)
    component = component_of[labels.ravel()[cell]]
    first = np.full(total, labels.size)
    first[component[::-1]] = cell[::-1]  # the last to write is the first cell
    order = np.argsort(first)[: np.count_nonzero(first < labels.size)]  # by scan, and within a scan by first cell
    scan = first[order] // ((rows + 1) * columns)
    counts = np.bincount(scan, minlength=scans)
    number = np.zeros(total, small)
    number[order] = np.arange(len(order)) - (np.cumsum(counts) - counts)[scan] + 1
    label = number[component]
    if rho_seam.size:
        joined = np.zeros(total, bool)
        joined[component_of[rho_seam[0]]] = True
        around = np.flatnonzero(joined[component])
        turn = (row[around] - first[component[around]] // columns) % rows
        label[around[np.minimum(turn, rows - turn) > rows // 4]] *= -1
    labels.ravel()[cell] = label
    return labels, counts


def _joined(pairs: Int[np.ndarray, "2 pairs"], total: int) -> Int[np.ndarray, " total"]:
    """The least label that each label can be reached from by pairs; few are in one, and ways are short."""
    least = np.arange(total)
    while (least[pairs[0]] != least[pairs[1]]).any():
        low = least[pairs].min(axis=0)
        for side in pairs:
            np.minimum.at(least, side, low)
    return least


def _touching(
    one: Int[np.ndarray, "scans cells"], other: Int[np.ndarray, "scans cells"], *, wrap: bool
) -> Int[np.ndarray, "2 pairs"]:
    """Pairs of labels that touch: cell k of one side touches cells k-1, k and k+1 of the other."""
    scan, cell = np.nonzero(one)
    if not len(cell) or not other.any():
        return np.zeros((2, 0), one.dtype)
    near = cell + np.array([[-1], [0], [1]])
    beyond = other[scan, near % one.shape[1]]
    touch = beyond != 0
    if not wrap:
        touch &= (near >= 0) & (near < one.shape[1])
    return np.stack([np.broadcast_to(one[scan, cell], touch.shape)[touch], beyond[touch]])
