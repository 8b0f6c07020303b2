"""``jaxsonar convert``: recordings of any kind to scan logs."""

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxsonar.sensors.ring import Ring

from jaxsonar.cli.arguments import RING_HELP, filename, filename_ending_in
from jaxsonar.cli.console import print_status
from jaxsonar.cli.inputs import InputMessages, add_log_arguments, input_options, load_checked_ring, read_log
from jaxsonar.reports.text import plural

SUMMARY = "Convert recordings, ROS bags and tables to scan logs, and scan logs between CSV and Parquet."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``jaxsonar convert``."""
    add_log_arguments(parser, name="source", metavar="IN")
    parser.add_argument(
        "destination", type=filename_ending_in(".csv", ".parquet"), metavar="OUT", help="scan log, .csv or .parquet"
    )
    parser.add_argument(
        "--ring", type=filename, help=f"the sensors, where IN names sensors or numbers must be checked: {RING_HELP}"
    )
    parser.add_argument(
        "--ring-out",
        type=filename_ending_in(".toml"),
        metavar="RING2",
        help="bag: write the ring that /tf_static and field_of_view describe, TOML",
    )


def run(options: argparse.Namespace) -> int:
    """Run ``jaxsonar convert``. Returns 1 if there is no scan."""
    from jaxsonar.fileio.atomic_files import check_outputs, shown
    from jaxsonar.scans.log_file import save_log, unmarked_paths, unmarked_warning
    from jaxsonar.sensors.ring_toml import save_ring

    check_outputs({"OUT": options.destination, "--ring-out": options.ring_out}, [options.source, options.ring])
    messages = InputMessages(strict=options.strict)
    ring = None if options.ring is None else load_checked_ring(options.ring, messages)
    if options.ring_out is not None:
        ring = _ring_of_bag(options, messages)
    log = read_log(options.source, options, messages, ring=ring)
    if count := unmarked_paths(log):
        messages.warn(_without_ring(count) if ring is None and _is_raw(options) else unmarked_warning(count))
    messages.warn_of_stamps(log)
    messages.check()
    if not len(log):
        print_status(f"nothing converted: {shown(options.source)}: no scan: the log is empty")
        return 1
    save_log(log, options.destination)
    if ring is not None and options.ring_out is not None:
        save_ring(ring, options.ring_out)
    silent, old = len(log.tx) - log.echo_count, int((log.age > 0).sum())
    more = [plural(silent, "silent reading")] * (silent > 0) + [f"{plural(old, 'reading')} not renewed"] * (old > 0)
    echoes = f"{log.echo_count} echo{'es' * (log.echo_count != 1)}"
    print_status(", ".join([plural(len(log), "scan"), echoes, *more]))
    return 0


def _is_raw(options: argparse.Namespace) -> bool:
    """Whether IN is a raw recording."""
    from jaxsonar.recordings.file_content import file_content

    return options.from_ == "record" or file_content(options.source).format == "record"


def _without_ring(count: int) -> str:
    """A warning about a raw recording that is converted without its ring: what, likely cause, what to do."""
    what = f"{count} paths of scans without an echo count as silent, whether or not they were measured"
    return f"{what}; --ring is missing, which tells the paths of each firing group; give --ring RING"


def _ring_of_bag(options: argparse.Namespace, messages: InputMessages) -> "Ring":
    """The ring that a bag describes.

    Raises:
        SonarError: a ring was given as well, or the bag does not describe one.
    """
    from jaxsonar.hardware.errors import SonarError
    from jaxsonar.recordings.file_content import file_content
    from jaxsonar.recordings.rosbag_log import ring_from_bag

    if options.ring is not None:
        raise SonarError(f"--ring {options.ring}: --ring-out came, too; allowed is one of them")
    if file_content(options.source).format != "bag":
        raise SonarError(f"--ring-out {options.ring_out}: IN is no ROS bag; allowed is --ring-out with a ROS bag")
    return ring_from_bag(options.source, options=input_options(options), on_note=messages.note)
