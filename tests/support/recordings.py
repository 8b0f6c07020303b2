"""Published recordings for tests, if they are on this machine."""

import os
from pathlib import Path

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
