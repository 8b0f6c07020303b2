"""Published recordings for tests, if they are on this machine."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxsonar.hardware.errors import SonarError

DATA = Path(os.environ.get("JAXSONAR_DATA") or Path(__file__).parents[3] / "shared" / "data")


def recorded(name):
    """The folder of a recording; skips the test if it is missing."""
    if not (DATA / name).is_dir():
        pytest.skip(f"the recording {name} is not in {DATA}; it is not part of the project")
    return DATA / name


def refused(call, *args, **kwargs):
    """Check that a call raises a SonarError with one printable line. Returns the message."""
    with pytest.raises(SonarError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert message.isprintable()  # no line break, too
    return message


def write_corridor8_laser(folder, scans=12):
    """Write a corridor8 recording of a laser that moves through a room of 4 m x 3 m (mm, tenths of a degree)."""
    folder.mkdir()
    bearing = np.radians(-90.4 + 0.5 * np.arange(361))
    beam = np.stack([np.cos(bearing), np.sin(bearing)], -1)
    lasers, poses = [], []
    for k in range(scans):
        x = 0.05 * k + 0.109
        with np.errstate(divide="ignore"):
            reach = np.min([np.abs((4 - x) / beam[:, 0]), np.abs(1.5 / beam[:, 1])], axis=0)
        ranges = np.where(np.isfinite(reach), np.round(1000 * reach), 81910).astype(int)
        lasers.append(f"{1000 + 200 * k} {' '.join(map(str, ranges))}\n")
        poses.append(f"{1000 + 200 * k} {50 * k} 0 0\n")
    (folder / "laser.txt").write_text("".join(lasers))
    (folder / "poses.txt").write_text("".join(poses))
