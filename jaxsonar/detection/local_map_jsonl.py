"""Local models as JSON Lines, one object a scan (robot frame)."""

import json
import os
from collections.abc import Iterable

from jaxsonar.detection.extract import LocalModel
from jaxsonar.fileio.atomic_files import open_output


def save_models(models: Iterable[LocalModel], path: str | os.PathLike[str]) -> None:
    """Write local models as they come; ``-`` is standard output. The file appears once it is complete."""
    with open_output(path) as file:
        for model in models:
            json.dump(model.as_json(), file, allow_nan=False)
            file.write("\n")
