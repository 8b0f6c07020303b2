"""Sizes of padded arrays: few different shapes, so that few programs are compiled."""

import numpy as np


def bucket_size(count: int, *, least: int) -> int:
    """Smallest of a few sizes that holds this many rows.

    The sizes are 1, 3/2, 2, 3, 4, 6, ... times ``least`` if that is a power of two. Otherwise each size is 4/3 of the
    previous one.

    Args:
        count: number of rows that must fit.
        least: smallest size, at least 2.
    """
    size = least
    while size < count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def next_power_of_two(count: int, *, least: int) -> int:
    """Smallest power of two that holds this many rows, but at least ``least``: fewer shapes than ``bucket_size``."""
    return max(least, 1 << max(count - 1, 0).bit_length())


def pad_rows(array: np.ndarray, rows: int, *, fill: float | int = 0) -> np.ndarray:
    """The array with this many rows; new rows hold ``fill``. ``np.pad`` takes ten times as long."""
    padded = np.full((rows, *array.shape[1:]), fill, array.dtype)
    padded[: len(array)] = array
    return padded
