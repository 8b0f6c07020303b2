"""The columns of the result tables, and their encoding as Parquet with units in the field metadata."""

import io
from typing import Any, NamedTuple

from jaxsonar.detection.local_model import KIND_NAMES
from jaxsonar.hardware.errors import SonarError

Columns = dict[str, Any]
"""Arrays of equal length, by column name."""


class ParquetColumn(NamedTuple):
    """A column of a table."""

    type: str
    """Name of the pyarrow type."""
    unit: str
    """Unit of the numbers; empty if they have none."""
    about: str
    """Description; part of the file format."""


SCAN_COLUMNS = {
    "source": ParquetColumn("string", "", "the log, by the name that it has in the manifest"),
    "row": ParquetColumn("int64", "", "row of the scan in its log, from 0"),
    "scan": ParquetColumn("int64", "", "number of the scan"),
    "stamp": ParquetColumn("float64", "s", "time of the scan"),
    "pose_x": ParquetColumn("float64", "m", "world_from_robot"),
    "pose_y": ParquetColumn("float64", "m", "world_from_robot"),
    "pose_theta": ParquetColumn("float64", "rad", "world_from_robot, counter-clockwise"),
}
PROBABILITY_COLUMNS = {
    f"p_{kind}": ParquetColumn("float64", "", f"probability that it is a {kind}") for kind in KIND_NAMES
}
SEGMENT_COLUMNS = {
    name: ParquetColumn("float64", "m", "an end of the local segment, robot frame") for name in ("x1", "y1", "x2", "y2")
}
TABLES: dict[str, dict[str, ParquetColumn]] = {
    "scans": SCAN_COLUMNS
    | {
        "echoes": ParquetColumn("int64", "", "echoes in the log"),
        "left_out": ParquetColumn("int64", "", "of them of pairs of sensors that the ring does not listen to"),
        "in_range": ParquetColumn("int64", "", "of them within the maximum range, without those left out"),
        "lines": ParquetColumn("int64", "", "rows in the table of lines"),
        "points": ParquetColumn("int64", "", "corners, edges and circles in the table of points"),
        "undecided": ParquetColumn("int64", "", "reflectors of undecided kind in the table of points"),
        "sigma": ParquetColumn("float64", "m", "noise of the ranges, given or estimated; method ml"),
        "empty": ParquetColumn("string", "", "why there is no line"),
    },
    "lines": SCAN_COLUMNS
    | {
        "rho": ParquetColumn("float64", "m", "distance of the wall, robot frame"),
        "theta": ParquetColumn("float64", "rad", "direction of its normal, robot frame, in [-pi, pi)"),
        **SEGMENT_COLUMNS,
        "evidence": ParquetColumn("float64", "nat", "how strong it is; method ml"),
        "votes": ParquetColumn("int64", "", "how strong it is: arc points in its component; method hough"),
        "echoes": ParquetColumn("int64", "", "echoes that it explains"),
        "cov_rho": ParquetColumn("float64", "m^2", "covariance of (rho, theta); method ml"),
        "cov_rho_theta": ParquetColumn("float64", "m rad", "covariance of (rho, theta); method ml"),
        "cov_theta": ParquetColumn("float64", "rad^2", "covariance of (rho, theta); method ml"),
    },
    "points": SCAN_COLUMNS
    | {
        "kind": ParquetColumn("string", "", "corner, edge, or undecided: then it may be a wall, too"),
        "x": ParquetColumn("float64", "m", "robot frame; of a wall the middle of what was seen"),
        "y": ParquetColumn("float64", "m", "robot frame"),
        "cov_x": ParquetColumn("float64", "m^2", "covariance of (x, y); corners, edges and circles"),
        "cov_xy": ParquetColumn("float64", "m^2", "covariance of (x, y); corners, edges and circles"),
        "cov_y": ParquetColumn("float64", "m^2", "covariance of (x, y); corners, edges and circles"),
        "radius": ParquetColumn("float64", "m", "radius of a circle, whose x, y are its center"),
        "cov_radius": ParquetColumn("float64", "m^2", "variance of the radius; circles"),
        "rho": ParquetColumn("float64", "m", "of what is undecided, if it is a wall"),
        "theta": ParquetColumn("float64", "rad", "of what is undecided, if it is a wall"),
        **PROBABILITY_COLUMNS,
        "echoes": ParquetColumn("int64", "", "echoes that it explains"),
    },
}
"""Columns of each table, the same for both methods. A value that a method does not compute is null."""


def encode_parquet(name: str, columns: Columns) -> bytes:
    """Encode a table as a Parquet file. NaN becomes null; units are in the metadata of the fields."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields, arrays = [], []
    for key, (type_name, unit, about) in TABLES[name].items():
        type_ = getattr(pa, type_name)()
        arrays.append(pa.array(columns[key], type=type_, from_pandas=True))
        fields.append(pa.field(key, type_, metadata={"unit": unit, "about": about}))
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), sink, compression="zstd")
    return sink.getvalue()


def check_parquet() -> None:
    """Check that pyarrow is installed.

    Raises:
        SonarError: the extra is missing.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise SonarError("batch writes Parquet and needs the parquet extra: pip install 'jaxsonar[parquet]'") from None
