"""Regions of cohesive occupied cells, by OpenCV: the one file that imports cv2 (paper, section 4)."""

import cv2
import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components as graph_components

_SHORT = 1 << 16  # cells that have less than 2^15 components


def label_components(
    occupied: Bool[np.ndarray, "scans theta rho"],
) -> tuple[Int[np.ndarray, "scans theta rho"], Int[np.ndarray, " scans"]]:
    """8-connected components of the accumulators of a batch of scans, joined across both seams of the plane of lines.

    The first and the last row touch, because theta wraps; cells of the first column touch those half a turn further,
    because (-rho, theta) is the line (rho, theta + pi). All scans go through OpenCV as one image.

    Args:
        occupied: highly occupied cells, rows theta, columns rho.

    Returns:
        labels: 0 for no component, else k or -k for component k of that scan, counted from 1 in the order of cells.
            Minus marks the far side of a component that joined across rho = 0: cells more than a quarter turn from its
            first cell.
        counts: number of components of each scan.
    """
    scans, rows, columns = occupied.shape
    if scans == 0:
        return np.zeros(occupied.shape, np.int16), np.zeros(0, np.int64)
    image = np.zeros((scans, rows + 1, columns), np.uint8)  # an empty row keeps scans apart
    image[:, :rows] = occupied
    total, stacked = cv2.connectedComponents(image.reshape(-1, columns), connectivity=8, ltype=cv2.CV_32S)
    flat = stacked.reshape(scans, rows + 1, columns)[:, :rows]

    theta_seam = _touching(flat[:, 0], flat[:, -1], wrap=False)
    rho_seam = _touching(flat[:, :, 0], np.roll(flat[:, :, 0], rows // 2, axis=1), wrap=True)
    pairs = np.concatenate([theta_seam, rho_seam])
    cell, part = np.flatnonzero(occupied), flat[occupied]  # few of all cells
    component = part
    if len(pairs):
        graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(total, total))
        component = graph_components(graph, directed=False)[1][part]
    _, first, component = np.unique(component, return_index=True, return_inverse=True)
    scan_of_component = cell[first] // (rows * columns)
    order = np.argsort(first)  # by scan, and within a scan by first cell
    counts = np.bincount(scan_of_component, minlength=scans)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order)) - (np.cumsum(counts) - counts)[scan_of_component[order]] + 1

    labels = np.zeros(occupied.size, np.int16 if rows * columns <= _SHORT else np.int32)
    labels[cell] = number[component]
    if len(rho_seam):
        across = np.isin(component, component[np.isin(part, rho_seam)])
        turn = (cell // columns % rows - (cell[first] // columns % rows)[component]) % rows
        far = across & (np.minimum(turn, rows - turn) > rows // 4)
        labels[cell[far]] *= -1
    return labels.reshape(occupied.shape), counts


def _touching(
    one: Int[np.ndarray, "scans cells"], other: Int[np.ndarray, "scans cells"], *, wrap: bool
) -> Int[np.ndarray, "pairs 2"]:
    """Pairs of labels that touch: cell k of one side touches cells k-1, k and k+1 of the other."""
    if not one.any() or not other.any():
        return np.zeros((0, 2), np.int32)
    found = []
    for shift in (-1, 0, 1):
        shifted = np.roll(other, shift, axis=1)
        if not wrap and shift:
            shifted[:, 0 if shift > 0 else -1] = 0
        touch = (one > 0) & (shifted > 0)
        found.append(np.stack([one[touch], shifted[touch]], axis=-1))
    pairs = np.concatenate(found)
    return np.unique(pairs, axis=0)
