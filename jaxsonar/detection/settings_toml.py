"""Hough settings in TOML files: written beside every result, and read with the option ``--settings``."""

from dataclasses import asdict, fields
from pathlib import Path

import msgspec

from jaxsonar import kernels
from jaxsonar.fileio.atomic_files import read_toml, reason, shown, write_toml
from jaxsonar.hardware.errors import SonarError

_File = msgspec.defstruct(
    "_File",
    [(field.name, field.type, field.default) for field in fields(kernels.HoughSettings)],
    forbid_unknown_fields=True,
)


def load_settings(filename: Path | str) -> kernels.HoughSettings:
    """Load settings from TOML; missing keys keep their defaults.

    Raises:
        SonarError: no such file, invalid TOML, an unknown key, or a value of a wrong type or out of range.
    """
    content = read_toml(filename, what="settings")
    content.pop("command", None)  # options of the command, for information only
    try:
        return kernels.HoughSettings(**msgspec.structs.asdict(msgspec.convert(content, _File)))
    except (ValueError, OverflowError) as failure:  # unknown key, wrong type, out of range
        keys = ", ".join(field.name for field in fields(kernels.HoughSettings))
        raise SonarError(f"{shown(filename)}: {reason(failure)}; the keys are {keys}") from None


def save_settings(settings: kernels.HoughSettings, filename: Path | str) -> None:
    """Write settings so that ``load_settings`` restores them."""
    write_toml(asdict(settings), filename)
