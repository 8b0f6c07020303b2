"""Print the table: ``python -m benchmarks.aural``.

Mono-, bi-, tri- and multi-aural measurements of one surface (Lawitzky et al.), a pair of transmitters (Kleeman and
Kuc), a scan of a ring, and one shot of a ring whose transmitters send separable codes. For each: Cramer-Rao bounds of
a wall, error rates of plane, corner and edge, and the noise-free distances between these kinds (sensitivity index d').
"""

import argparse

from benchmarks.aural.table import markdown, rows


def main() -> None:
    """Print the table."""
    argparse.ArgumentParser(prog="python -m benchmarks.aural", description=__doc__).parse_args()
    print(markdown(rows()), end="")


if __name__ == "__main__":
    main()
