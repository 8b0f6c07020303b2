"""Ring files with a calibration: the ring as ``load_ring`` reads it, and the uncertainty of its parameters."""

import os
from typing import Any

import numpy as np
import tomli_w
from jaxtyping import Float

from jaxsonar.calibration.calibration_result import Calibration, RunResiduals
from jaxsonar.calibration.echo_model import EchoStatistics
from jaxsonar.fileio.atomic_files import open_output
from jaxsonar.geometry.robust_statistics import robust_deviation
from jaxsonar.sensors.ring_toml import ring_toml

DECIMALS = 8
"""Decimal places of all numbers in the table: 10 nm."""


def save_calibration(calibration: Calibration, filename: str | os.PathLike[str]) -> None:
    """Write the ring and a table ``[calibration]`` atomically.

    Args:
        calibration: the result to write.
        filename: the file; ``-`` is standard output.

    Raises:
        SonarError: the file cannot be written.
    """
    text = ring_toml(calibration.ring, each=True) + "\n" + tomli_w.dumps({"calibration": as_table(calibration)})
    with open_output(filename) as file:
        file.write(text)


def as_table(calibration: Calibration) -> dict[str, Any]:
    """The table ``[calibration]``: metres, metres per second, and degrees where the name ends in ``_deg``."""
    table: dict[str, Any] = {
        "estimated": list(calibration.free),
        "scans": calibration.scans,
        "echoes": calibration.echoes,
        "echoes_explained": len(calibration.residuals),
        "explained": _short(calibration.explained.measured),
        "explained_required": _short(calibration.explained.required),
        "sigma": _short(calibration.sigma),
        "residual_rms_before": _short(calibration.rms_before),
        "residual_rms_after": _short(calibration.rms),
    }
    if "offset" in calibration.free:
        table["range_offset_sd"] = _list(calibration.range_offset_sd)  # relative to their mean
        if "mean_offset" not in calibration.held:
            table["mean_offset_sd"] = _short(calibration.mean_offset_sd)
    if "speed" in calibration.free:
        table["speed_of_sound_sd"] = _short(calibration.speed_of_sound_sd)
    if "radius" in calibration.free:
        table["radius"], table["radius_sd"] = (_short(value) for value in calibration.radius)
    if "position" in calibration.free:
        table["x_sd"], table["y_sd"] = (_list(column) for column in calibration.position_sd.T)
    if "offset" in calibration.free and {"position", "radius"} & set(calibration.free):
        correction, sd = calibration.effective_correction
        table["effective_correction"], table["effective_correction_sd"] = _list(correction), _list(sd)
    if "heading" in calibration.free:
        table["heading_sd_deg"] = _list(np.degrees(calibration.heading_sd))
    if calibration.run is not None:
        table["run"] = _run_table(calibration.run)
    if calibration.echo_model is not None:
        table["echo_model"] = _echo_model_table(calibration.echo_model)
    table["held"] = dict(calibration.held)
    table["correlations"] = [
        {"between": [a, b], "value": round(value, 3)} for a, b, value in calibration.correlations()
    ]
    return table


def _run_table(run: RunResiduals) -> dict[str, Any]:
    """Where the scale of the ranges comes from, and the robust spread of the residuals (metres)."""
    table: dict[str, Any] = {"tracks": run.scale.tracks, "stretches": run.scale.stretches}
    if np.isfinite(run.scale.sd):
        table["scale"] = _short(np.exp(run.scale.log_scale))
        table["scale_sd"] = _short(run.scale.sd)
    for name, residual in (("robust_sigma_before", run.before), ("robust_sigma_after", run.after)):
        table[name] = _short(robust_deviation(residual))
    return table


def _echo_model_table(model: EchoStatistics) -> dict[str, Any]:
    """Noise (metres, shares) and detections over the angle off axis (degrees)."""
    return {
        "core_sd": _short(model.core_sd),
        "tail_share": round(model.tail_share, 4),
        "tail_scale": _short(model.tail_scale),
        "too_short": round(model.too_short, 4),
        "too_long": round(model.too_long, 4),
        "echoes": model.echoes,
        "off_axis_deg": _list(np.degrees(model.off_axis)),
        "expected": model.expected.tolist(),
        "heard": model.heard.tolist(),
    }


def _short(value: float) -> float:
    return round(float(value), DECIMALS)


def _list(values: Float[np.ndarray, " sensors"]) -> list[float]:
    return [_short(value) for value in values]
