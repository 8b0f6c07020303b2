"""Metrics of the suite, their JSON file, the baseline and the gate.

A ratio compares a time of jaxsonar with another time of the same run, so it is comparable between machines. Only
ratios have a tolerance and are in the baseline.
"""

import importlib.metadata
import json
import math
import platform
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from jaxsonar.batch_jobs.worker_environment import available_cores
from jaxsonar.fileio.atomic_files import atomic_write, reason
from jaxsonar.hardware.errors import SonarError

BASELINE = Path(__file__).with_name("baseline.json")
RATIO = "x"
"""The unit of ratios."""
SIZES = ("gate", "quick", "full")
"""Sizes of a run: the ratios for CI, one minute, everything."""


@dataclass(frozen=True)
class Metric:
    """One figure."""

    key: str
    """Workload, quantity, and the other side of a ratio: ``throughput.hough:numpy``."""
    value: float
    """NaN if not measured."""
    unit: str
    """``x`` for a ratio."""
    direction: Literal["higher", "lower"] = "lower"
    """Whether higher or lower values are better."""
    tolerance: float | None = None
    """Allowed factor by which it may be worse than the baseline; None: not part of the gate."""
    target: float | None = None
    """Target: minimum (higher) or maximum (lower)."""

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None without a target or a value."""
        if self.target is None or self.value != self.value:
            return None
        return self.value >= self.target if self.direction == "higher" else self.value <= self.target

    def worse(self, than: float) -> float:
        """Factor by which this is worse than another value; infinite if it was not measured."""
        if not (self.value > 0 and than > 0):
            return float("inf")
        return than / self.value if self.direction == "higher" else self.value / than

    def better(self, other: "Metric") -> "Metric":
        """The better one of two measurements."""
        return other if other.worse(self.value) < 1 or self.value != self.value else self


@dataclass(frozen=True)
class Options:
    """Options of a run."""

    size: str = "full"
    """One of SIZES."""
    seed: int = 0
    """Seed of rooms, poses and noise."""

    def pick(self, *, gate: int, quick: int, full: int) -> int:
        """The number for the size of the run."""
        return {"gate": gate, "quick": quick, "full": full}[self.size]


@dataclass(frozen=True)
class Results:
    """Results of one run and its environment."""

    environment: dict[str, Any]
    options: dict[str, Any]
    metrics: dict[str, Metric]
    """Metrics by key."""

    @classmethod
    def of(cls, metrics: Iterable[Metric], options: Mapping[str, Any]) -> "Results":
        """Metrics of this process, on this machine."""
        return cls(environment(), dict(options), {metric.key: metric for metric in metrics})

    def value(self, key: str) -> float:
        """Value of a metric; NaN if it was not measured."""
        return self.metrics[key].value if key in self.metrics else float("nan")

    def save(self, path: Path) -> None:
        """Write as JSON; NaN becomes null."""
        content: dict[str, Any] = {"environment": self.environment, "options": self.options}
        content["metrics"] = [
            asdict(metric) | {"value": None if metric.value != metric.value else metric.value}
            for metric in self.metrics.values()
        ]
        with atomic_write(path) as file:
            json.dump(content, file, indent=1, allow_nan=False)
            file.write("\n")

    @classmethod
    def load(cls, path: Path) -> "Results":
        """Read a file that ``save`` wrote.

        Raises:
            SonarError: the file is not a result of this suite.
        """
        content = _read(path, "metrics", "environment", "options")
        names = {one.name for one in fields(Metric)}
        metrics = []
        for entry in content["metrics"]:
            row: dict[str, Any] = {key: entry[key] for key in names}
            row["value"] = float("nan") if row["value"] is None else row["value"]
            metrics.append(Metric(**row))
        return cls(content["environment"], content["options"], {one.key: one for one in metrics})


def environment() -> dict[str, Any]:
    """Hardware, versions, commit and time."""
    import jax

    names = ("jaxsonar", "jax", "jaxlib", "numpy", "scipy", "opencv-python-headless", "numba", "scikit-image")
    return {
        "device": jax.devices()[0].device_kind,
        "platform": jax.devices()[0].platform,
        "processor": _processor(),
        "cores": available_cores(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: _version(name) for name in names},
        "commit": _commit(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def without_nan(value: Any) -> Any:
    """Replace NaN and infinity by None, because JSON has neither."""
    if isinstance(value, dict):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, list):
        return [without_nan(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> str | None:
    """The commit, with ``+`` if files differ from it; None without git or a repository."""
    root = Path(__file__).parent

    def git(*call: str) -> str:
        return subprocess.run(["git", *call], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def ratios(metrics: Iterable[Metric]) -> dict[str, Metric]:
    """The ratios that the gate compares."""
    return {one.key: one for one in metrics if one.unit == RATIO and one.tolerance is not None}


def save_baseline(results: Results, path: Path = BASELINE) -> None:
    """Write the ratios of a gate run."""
    rows = {
        key: {"value": round(one.value, 4), "direction": one.direction, "tolerance": one.tolerance}
        for key, one in ratios(results.metrics.values()).items()
    }
    with atomic_write(path) as file:
        json.dump({"environment": results.environment, "ratios": rows}, file, indent=1)
        file.write("\n")


def load_baseline(path: Path = BASELINE) -> dict[str, Any]:
    """Read a file that ``save_baseline`` wrote.

    Raises:
        SonarError: the file is not a baseline.
    """
    return _read(path, "ratios")


def _read(path: Path, *keys: str) -> dict[str, Any]:
    """Read a JSON object with these keys."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as failure:
        raise SonarError(f"{path}: {reason(failure)}; needed is a file written by this suite") from None
    if not isinstance(content, dict) or not set(keys) <= set(content):
        raise SonarError(f"{path}: no {', '.join(keys)} in it; needed is a file written by this suite")
    return content


def failures(metrics: Mapping[str, Metric], baseline: Mapping[str, Any], only: Iterable[str] = ()) -> dict[str, str]:
    """Ratios that are missing or worse than the baseline by more than the tolerance: message by key.

    Args:
        metrics: the measured metrics.
        baseline: the reference.
        only: the measured workloads; all if empty.
    """
    only, wrong = set(only), {}
    for key, was in baseline["ratios"].items():
        if only and key.partition(".")[0] not in only:
            continue
        if key not in metrics:
            wrong[key] = f"{key}: not measured; the baseline has {was['value']:g}"
            continue
        worse = metrics[key].worse(was["value"])
        if worse > was["tolerance"]:
            wrong[key] = (
                f"{key}: {metrics[key].value:.3g} x, {worse:.2f} times worse than the baseline's {was['value']:.3g} x; "
                f"allowed is {was['tolerance']:g} times"
            )
    return wrong
