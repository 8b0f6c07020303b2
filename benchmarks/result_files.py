"""Helpers of the accuracy benchmarks for their JSON files."""

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np


def versions() -> dict[str, Any]:
    """Versions, device and commit."""
    names = ("jaxsonar", "jax", "jaxlib", "numpy", "scipy")
    root = Path(__file__).parent
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    return {name: importlib.metadata.version(name) for name in names} | {
        "cv2": cv2.__version__,
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "commit": commit.stdout.strip(),
    }


def without_nan(value: Any) -> Any:
    """Replace NaN by None, because JSON has no NaN."""
    if isinstance(value, dict):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, list):
        return [without_nan(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
