"""The command line: one module per command, and what the commands share."""

from jaxsonar.cli.app import main as main
