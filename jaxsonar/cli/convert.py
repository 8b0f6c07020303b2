"""``jaxsonar convert``: convert scan logs between formats, and recordings to scan logs."""

import argparse

from jaxsonar.cli.console import print_status

SUMMARY = "Convert scan logs between CSV and Parquet, and recordings of devices to scan logs."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar convert``."""
    parser.add_argument("source", metavar="IN", help="log or recording")
    parser.add_argument("destination", metavar="OUT", help="scan log, .csv or .parquet")
    formats = ("corridor8", "scitos24", "sew-amr", "csv", "parquet")
    parser.add_argument("--from", dest="from_", choices=formats, help="format of IN (default: by its suffix)")


def run(options: argparse.Namespace) -> None:
    """Run ``jaxsonar convert``."""
    from jaxsonar.scans.convert import convert as convert_log

    log = convert_log(options.source, options.destination, from_=options.from_)
    print_status(f"{len(log)} scans, {len(log.range)} echoes")
