"""Connected components analysis of occupied cells by OpenCV (paper, section 4). Only this module imports cv2."""

import cv2
import numpy as np
from jaxtyping import Bool, Int


def label_components(
    occupied: Bool[np.ndarray, "scans theta rho"],
) -> tuple[Int[np.ndarray, "scans theta_and_one rho"], Int[np.ndarray, " scans"]]:
    """8-connected components of the accumulators of a batch of scans, across both seams of the parameter space.

    The first and the last row are neighbors, because theta is periodic. Cells of the first column are neighbors of
    those half a turn away, because (-rho, theta) is the line (rho, theta + pi).

    Oracle: ``components`` of tests/support/oracles.py.

    Args:
        occupied: highly occupied cells, rows theta, columns rho.

    Returns:
        labels: 0 for no component, otherwise k or -k for component k of the scan, counted from 1 in the order of its
            cells. Negative labels mark the far side of a component that joins across rho = 0: cells more than a quarter
            turn from its first cell. The additional last row is empty; points without a cell have the index of its
            first cell.
        counts: number of components of each scan.
    """
    scans, rows, columns = occupied.shape
    # Label all scans as one image, which contains each run of empty rows as one row: few cells are occupied.
    cell = np.flatnonzero(occupied)
    cell += cell // (rows * columns) * columns  # index in the labels, which have one more row per scan
    row, column = np.divmod(cell, columns)
    image_row = np.full(len(cell), 2)
    np.minimum(row[1:] - row[:-1], 2, out=image_row[1:])
    image_row = np.cumsum(image_row)
    image = np.zeros((int(image_row[-1]) + 1 if len(image_row) else 1, columns), np.uint8)
    image[image_row, column] = 1
    dtype, label_type = (np.int16, cv2.CV_16U) if len(cell) < 1 << 15 else (np.int32, cv2.CV_32S)
    total, parts = cv2.connectedComponentsWithAlgorithm(image, 8, label_type, cv2.CCL_BBDT)  # fastest algorithm here
    labels = np.zeros((scans, rows + 1, columns), dtype)
    labels.ravel()[cell] = parts[image_row, column]

    # Find the pairs of parts that touch across the seams.
    theta_seam = _touching(labels[:, 0], labels[:, rows - 1], wrap=False)
    edge, half = labels[:, :rows, 0], rows // 2
    rho_seam = _touching(edge, np.concatenate([edge[:, half:], edge[:, :half]], axis=1), wrap=True)
    # Merge parts to components, number these by scan and first cell, and label their cells.
    component_of = _merge_labels(np.concatenate([theta_seam, rho_seam], axis=1), total)
    component = component_of[labels.ravel()[cell]]
    first = np.full(total, labels.size)
    first[component[::-1]] = cell[::-1]  # the first cell is written last
    order = np.argsort(first)[: np.count_nonzero(first < labels.size)]  # by scan, then by first cell
    scan = first[order] // ((rows + 1) * columns)
    counts = np.bincount(scan, minlength=scans)
    number = np.zeros(total, dtype)
    number[order] = np.arange(len(order)) - (np.cumsum(counts) - counts)[scan] + 1
    label = number[component]
    # Negate the labels of the far side of components that join across rho = 0.
    if rho_seam.size:
        joined = np.zeros(total, bool)
        joined[component_of[rho_seam[0]]] = True
        around = np.flatnonzero(joined[component])
        turn = (row[around] - first[component[around]] // columns) % rows
        label[around[np.minimum(turn, rows - turn) > rows // 4]] *= -1
    labels.ravel()[cell] = label
    return labels, counts


def _merge_labels(pairs: Int[np.ndarray, "2 pairs"], total: int) -> Int[np.ndarray, " total"]:
    """Smallest label that is connected to each label by pairs. Few labels are in pairs, and chains are short."""
    least = np.arange(total)
    while (least[pairs[0]] != least[pairs[1]]).any():
        low = least[pairs].min(axis=0)
        for side in pairs:
            np.minimum.at(least, side, low)
    return least


def _touching(
    one: Int[np.ndarray, "scans cells"], other: Int[np.ndarray, "scans cells"], *, wrap: bool
) -> Int[np.ndarray, "2 pairs"]:
    """Pairs of labels that touch: cell k of one side is a neighbor of cells k-1, k and k+1 of the other side."""
    scan, cell = np.nonzero(one)
    if not len(cell) or not other.any():
        return np.zeros((2, 0), one.dtype)
    near = cell + np.array([[-1], [0], [1]])
    beyond = other[scan, near % one.shape[1]]
    touch = beyond != 0
    if not wrap:
        touch &= (near >= 0) & (near < one.shape[1])
    return np.stack([np.broadcast_to(one[scan, cell], touch.shape)[touch], beyond[touch]])
