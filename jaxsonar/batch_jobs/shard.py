"""One task of a batch: consecutive scans of one file."""

from dataclasses import dataclass

from jaxsonar.scans.log_chunks import LogChunk


@dataclass(frozen=True)
class Shard:
    """Consecutive scans of one log: one task, and one file per table."""

    key: str
    """Name of its files, without suffix."""
    source: str
    """Name of the log."""
    filename: str
    """File to read: the log, or its staged copy."""
    format: str
    """csv or parquet."""
    size: int
    """Size of that file when the shard was planned, bytes."""
    modified_ns: int
    """Modification time of that file when the shard was planned, nanoseconds."""
    chunk: LogChunk
    """The scans in that file."""
    odometry: str = ""
    """NumPy file with the motion of the robot (``Log.motion``) in a staged copy; empty if there is none."""
