"""The example of a custom loss runs and finds the simulated temperatures."""

import re
import runpy
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "docs" / "temperature_per_scan.py"


@pytest.mark.slow
def test_the_temperature_of_every_scan_is_found(capsys):
    runpy.run_path(str(EXAMPLE))
    out = capsys.readouterr().out
    found = [float(number) for number in re.findall(r"(-?[\d.]+) deg C", out)]
    assert len(found) == 5
    assert found == sorted(found)  # the air warms up
    (rms,) = re.findall(r"RMS error ([\d.]+) K", out)
    assert float(rms) < 1.5  # the air changes by 8 K; the standard deviation of a single scan is 2.5 K
