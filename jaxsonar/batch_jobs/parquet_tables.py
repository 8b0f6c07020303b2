"""The tables that a batch gives, and how they are written: Parquet, units in the metadata of the fields."""

import io
from typing import Any, NamedTuple

from jaxsonar.hardware.errors import SonarError

Columns = dict[str, Any]
"""Arrays of one length, by name."""


class Column(NamedTuple):
    """One column of a table."""

    type: str
    """As pyarrow calls it."""
    unit: str
    """Of its numbers; empty where they have none."""
    about: str
    """What it says."""


SCAN = {
    "source": Column("string", "", "the log, by the name that it has in the manifest"),
    "row": Column("int64", "", "row of the scan in its log, from 0"),
    "scan": Column("int64", "", "number of the scan"),
    "stamp": Column("float64", "s", "time of the scan"),
    "pose_x": Column("float64", "m", "world_from_robot"),
    "pose_y": Column("float64", "m", "world_from_robot"),
    "pose_theta": Column("float64", "rad", "world_from_robot, counter-clockwise"),
}
PROBABILITY = {
    f"p_{kind}": Column("float64", "", f"probability that it is a {kind}") for kind in ("plane", "corner", "edge")
}
ENDS = {name: Column("float64", "m", "an end of the local segment, robot frame") for name in ("x1", "y1", "x2", "y2")}
TABLES: dict[str, dict[str, Column]] = {
    "scans": SCAN
    | {
        "echoes": Column("int64", "", "echoes in the log"),
        "left_out": Column("int64", "", "of them of pairs of sensors that the ring does not listen to"),
        "in_range": Column("int64", "", "of them within the maximum range, without those left out"),
        "lines": Column("int64", "", "rows in the table of lines"),
        "points": Column("int64", "", "corners and edges in the table of points"),
        "undecided": Column("int64", "", "reflectors of undecided kind in the table of points"),
        "sigma": Column("float64", "m", "noise of the ranges, given or estimated; method ml"),
        "empty": Column("string", "", "why there is no line"),
    },
    "lines": SCAN
    | {
        "rho": Column("float64", "m", "distance of the wall, robot frame"),
        "theta": Column("float64", "rad", "direction of its normal, robot frame, in [-pi, pi)"),
        **ENDS,
        "evidence": Column("float64", "nat", "how strong it is; method ml"),
        "votes": Column("int64", "", "how strong it is: arc points in its component; method hough"),
        "echoes": Column("int64", "", "echoes that it explains"),
        "cov_rho": Column("float64", "m^2", "covariance of (rho, theta); method ml"),
        "cov_rho_theta": Column("float64", "m rad", "covariance of (rho, theta); method ml"),
        "cov_theta": Column("float64", "rad^2", "covariance of (rho, theta); method ml"),
    },
    "points": SCAN
    | {
        "kind": Column("string", "", "corner, edge, or undecided: then it may be a wall, too"),
        "x": Column("float64", "m", "robot frame; of a wall the middle of what was seen"),
        "y": Column("float64", "m", "robot frame"),
        "cov_x": Column("float64", "m^2", "covariance of (x, y); corners and edges"),
        "cov_xy": Column("float64", "m^2", "covariance of (x, y); corners and edges"),
        "cov_y": Column("float64", "m^2", "covariance of (x, y); corners and edges"),
        "rho": Column("float64", "m", "of what is undecided, if it is a wall"),
        "theta": Column("float64", "rad", "of what is undecided, if it is a wall"),
        **PROBABILITY,
        "echoes": Column("int64", "", "echoes that it explains"),
    },
}
"""Columns of each table, the same whatever the method; what a method does not give is null."""


def parquet(name: str, columns: Columns) -> bytes:
    """One table as a Parquet file; NaN becomes null, units stand in the metadata of the fields."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields, arrays = [], []
    for key, (kind, unit, about) in TABLES[name].items():
        made = getattr(pa, kind)()
        arrays.append(pa.array(columns[key], type=made, from_pandas=True))
        fields.append(pa.field(key, made, metadata={"unit": unit, "about": about}))
    sink = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), sink, compression="zstd")
    return sink.getvalue()


def check_parquet() -> None:
    """Complain before the work.

    Raises:
        SonarError: the extra is missing.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        raise SonarError("batch writes Parquet and needs the parquet extra: pip install 'jaxsonar[parquet]'") from None
