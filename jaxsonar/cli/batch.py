"""The command ``batch``: what it can be told, and what it does."""

import argparse
import sys
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any


def batch(options: argparse.Namespace) -> int:
    """``jaxsonar batch``; 1 if anything was set aside."""
    from jaxsonar.batch_jobs.run_batch import batch as run
    from jaxsonar.cli.console import _bar, _check_sigma_is_used, _count, _say_left_out
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.sensors.ring_toml import load_ring

    _check_sigma_is_used(options.sigma, options.method, None)
    if options.output == "-":
        raise SonarError("-o - came; allowed is a folder, which can hold tables")
    ring = load_ring(options.ring)
    settings = load_settings(options.settings) if options.settings else None
    with ExitStack() as stack:
        show: list[Callable[[int], None]] = []
        report = run(
            options.inputs,
            ring,
            options.output,
            method=options.method,
            sigma=options.sigma,
            settings=settings,
            engine=options.engine,
            scheduler=options.scheduler,
            workers=options.workers,
            on_planned=lambda scans: show.append(stack.enter_context(_bar("scans", scans))),
            on_done=lambda scans: show[0](scans),
        )
    if report.left_out:
        _say_left_out(ring.name, report.left_out)
    shards = _count(report.shards, "shard") + (f", {report.before} of them before" if report.before else "")
    _say(f"{report.scans} scans, {report.lines} lines, {shards}: {shown(options.output)}")
    if report.set_aside:
        _say(f"set aside: {report.aside}; {shown(report.manifest)} says why; the first: {report.set_aside[0]}")
        return 1
    return 0


def add_command(
    command: Callable[[str, str], argparse.ArgumentParser],
    *,
    whole: Callable[[int, int], Callable[[str], Any]],
    file: Callable[[str], str],
    choose_method: Callable[[argparse.ArgumentParser], None],
    texts: dict[str, str],
) -> None:
    """Tell the command line of it.

    Args:
        command: adds a command by name and summary.
        whole: a whole number within bounds.
        file: the name of a file.
        choose_method: adds ``--method`` and ``--sigma``.
        texts: help shared with other commands: ``ring``, ``settings``.
    """
    many = command("batch", "Lines of every scan of many logs, as Parquet; goes on where it was ended.")
    many.add_argument(
        "inputs",
        nargs="+",
        type=file,
        metavar="IN",
        help="logs (.csv, .parquet, .mcap; .bag, .db3: extra ros), and folders of logs",
    )
    many.add_argument("--ring", type=file, required=True, help=texts["ring"])
    choose_method(many)
    many.add_argument("--settings", type=file, metavar="TOML", help=texts["settings"])
    many.add_argument(
        "-o", "--output", type=file, metavar="DIR", required=True, help="scans/, lines/, points/, manifest.jsonl"
    )
    many.add_argument(
        "--engine", choices=("local", "dask"), default="local", help="default: local; dask: a cluster (extra cluster)"
    )
    many.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster (default: one on this machine)")
    many.add_argument("--workers", type=whole(1, 1024), metavar="N", help="processes (default: one a core, or a GPU)")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
