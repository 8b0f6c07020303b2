"""CSV files of the simulator: named columns of numbers, with errors that name row and column."""

import os
import re
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from jaxsonar.fileio.atomic_files import DECIMAL, read_bytes, shown
from jaxsonar.hardware.errors import SonarError

NUMBER = re.compile(DECIMAL)


def load_columns(
    filename: str | os.PathLike[str],
    *,
    what: str,
    entry: str,
    required: Sequence[str],
    optional: Sequence[str] = (),
    increasing: bool = False,
) -> dict[str, Float[np.ndarray, " rows"]]:
    """Columns of a CSV file by name.

    Args:
        filename: the file; its first row contains the column names, in any order.
        what: what the file contains, for errors.
        entry: what one row describes, for errors.
        required: names of columns that must be there.
        optional: names of columns that may be there.
        increasing: the column ``stamp`` must increase; otherwise it must not decrease.

    Raises:
        SonarError: no such file, no row, other columns, or an invalid value; the message names row and column.
    """
    try:
        text = read_bytes(filename, what=f"{what} (CSV)").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SonarError(f"{shown(filename)}: this is no text; needed is a CSV file of {what}") from None
    lines = enumerate(text.splitlines(), start=1)
    rows = [(number, line.split(",")) for number, line in lines if line.strip()]
    header = [name.strip() for name in rows[0][1]] if rows else []
    columns = ", ".join(required) + "".join(f" and optionally {name}" for name in optional)
    if len(set(header)) < len(header) or not set(required) <= set(header) <= {*required, *optional}:
        came = shown(",".join(header), 80) or "nothing"
        if len(header) == 1 and (found := re.search("[;\t]", header[0])):
            came = "tabs between the columns" if found[0] == "\t" else "semicolons between the columns"
            raise SonarError(
                f"{shown(filename)}: row 1: {came} came; allowed are commas between columns and points, not decimal "
                f"commas, in numbers: {columns}"
            )
        raise SonarError(f"{shown(filename)}: row 1: {came} came; allowed are the columns {columns}")
    values = np.empty((len(rows) - 1, len(header)))
    for index, (number, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise SonarError(
                f"{shown(filename)}: row {number}: {len(row)} values came; allowed are {len(header)}, as in row 1"
                + "; are these decimal commas? allowed are points in numbers" * (len(row) > len(header))
            )
        for column, text in enumerate(row):
            values[index, column] = float(text) if NUMBER.fullmatch(text.strip()) else np.nan
            largest = "1e12" if header[column] == "stamp" else "1e9"  # stamps since 1970 are 1.7e9 s
            if not abs(values[index, column]) <= float(largest):  # nor NaN
                place = f"{shown(filename)}: row {number}, column {header[column]}"
                raise SonarError(f"{place}: {shown(text, 40)!r} came; allowed is a finite number up to {largest}")
    if not len(values):
        raise SonarError(f"{shown(filename)}: no {entry} came; allowed is one or more")
    column_of = {name: values[:, column] for column, name in enumerate(header)}
    steps = np.diff(column_of.get("stamp", np.zeros(1)))
    wrong = np.flatnonzero(steps <= 0 if increasing else steps < 0)
    if len(wrong):
        number, row = rows[wrong[0] + 2]  # the header is the first row
        came = shown(row[header.index("stamp")], 40)
        place = f"{shown(filename)}: row {number}, column stamp"
        allowed = "later than" if increasing else "no earlier than"
        raise SonarError(f"{place}: {came} came; allowed is {allowed} in the row before")
    return column_of
