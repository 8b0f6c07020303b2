"""``jaxsonar batch``: the lines of every scan of many logs, as Parquet tables."""

import argparse
from collections.abc import Callable
from contextlib import ExitStack

from jaxsonar.cli.arguments import add_detection_arguments, filename, number
from jaxsonar.cli.console import check_sigma_is_used, print_left_out, print_status, progress_bar
from jaxsonar.cli.inputs import LOG_HELP, InputMessages, add_log_arguments, input_options, load_checked_ring
from jaxsonar.reports.text import plural

SUMMARY = "Lines of every scan of many logs, as Parquet; resumes after an interruption."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar batch``."""
    add_log_arguments(parser, name="inputs", metavar="IN", nargs="+", help=f"folder of logs, or {LOG_HELP}")
    add_detection_arguments(parser)
    parser.add_argument(
        "-o", "--output", type=filename, metavar="DIR", required=True, help="scans/, lines/, points/, manifest.jsonl"
    )
    parser.add_argument(
        "--engine", choices=("local", "dask"), default="local", help="default: local; dask: a cluster (extra cluster)"
    )
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask cluster (default: start one on this machine)"
    )
    parser.add_argument(
        "--workers",
        type=number(int, 1, 1024),
        metavar="N",
        help="processes (default: one per GPU or, without a GPU, per core)",
    )


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar batch``. Returns 1 if anything was set aside, or if no echo could be used."""
    from jaxsonar.batch_jobs.run_batch import batch as run_batch
    from jaxsonar.detection.settings_toml import load_settings
    from jaxsonar.fileio.atomic_files import shown
    from jaxsonar.hardware.errors import SonarError

    check_sigma_is_used(options.sigma, options.method)
    if options.output == "-":
        raise SonarError("-o - came; allowed is a folder, which can hold tables")
    messages = InputMessages(strict=options.strict)
    ring = load_checked_ring(options.ring, messages)
    messages.warn_of_noise(options.sigma)
    settings = load_settings(options.settings) if options.settings else None
    with ExitStack() as stack:
        show: list[Callable[[int], None]] = []

        def start(scans: int) -> None:
            messages.check()
            show.append(stack.enter_context(progress_bar("scans", scans)))

        report = run_batch(
            options.inputs,
            ring,
            options.output,
            method=options.method,
            sigma=options.sigma,
            settings=settings,
            engine=options.engine,
            scheduler=options.scheduler,
            workers=options.workers,
            options=input_options(options),
            on_note=messages.note,
            on_planned=start,
            on_done=lambda scans: show[0](scans),
        )
    if report.left_out:
        print_left_out(ring.name, report.left_out)
    shards = plural(report.shards, "shard") + (
        f", {report.resumed} of them by an earlier run" if report.resumed else ""
    )
    print_status(f"{report.scans} scans, {report.lines} lines, {shards}: {shown(options.output)}")
    for reason in report.unused:
        print_status(f"nothing found: {reason}")
    if report.set_aside:
        print_status(
            f"set aside: {report.set_aside_summary}; the reasons are in {shown(report.manifest)}; the first: "
            f"{report.set_aside[0]}"
        )
    return 1 if report.set_aside or not report.used_echoes else 0
