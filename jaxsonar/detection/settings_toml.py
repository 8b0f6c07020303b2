"""Settings of the extraction in TOML: written beside every result, and taken back with ``--settings``."""

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


def load_settings(path: Path | str) -> kernels.HoughSettings:
    """Settings from TOML; keys that are left out keep their defaults.

    Raises:
        SonarError: no such file, no TOML, an unknown key, a value of another type or out of range.
    """
    content = read_toml(path, what="settings")
    content.pop("command", None)  # what else was chosen, for whoever reads it
    try:
        return kernels.HoughSettings(**msgspec.structs.asdict(msgspec.convert(content, _File)))
    except (ValueError, OverflowError) as failure:  # an unknown key, another type, out of range
        keys = ", ".join(field.name for field in fields(kernels.HoughSettings))
        raise SonarError(f"{shown(path)}: {reason(failure)}; the keys are {keys}") from None


def save_settings(settings: kernels.HoughSettings, path: Path | str) -> None:
    """Write settings so that ``load_settings`` gives the same ones."""
    write_toml(asdict(settings), path)
