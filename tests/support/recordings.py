"""recordings."""

import os
from pathlib import Path

import pytest

from jaxsonar.hardware.errors import SonarError

DATA = Path(os.environ.get("JAXSONAR_DATA") or Path(__file__).parents[3] / "shared" / "data")


def recorded(name):
    if not (DATA / name).is_dir():
        pytest.skip(f"the recording {name} is not at {DATA}; it is no part of the project")
    return DATA / name


def refused(call, *args, **kwargs):
    with pytest.raises(SonarError) as caught:
        call(*args, **kwargs)
    message = str(caught.value)
    assert message.isprintable()  # so one line, too
    return message
