"""The fixture of a finished demo."""

import pytest


@pytest.fixture(scope="session")
def written(short_demo):
    """The folder of a short demo, its tables and its progress messages."""
    folder, tables, said = short_demo
    return folder / "demo", tables, said
