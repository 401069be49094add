"""The command ``pea``."""

import sys

from pea_core.entry import enter


def main() -> int:
    """Run the command line."""
    status: int = enter("pea_cli.cli", interrupted=130)
    return status


if __name__ == "__main__":
    sys.exit(main())
