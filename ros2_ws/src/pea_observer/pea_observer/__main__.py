"""``ros2 run pea_observer observer``."""

from pea_core.entry import enter


def main() -> None:
    """Run the node."""
    enter("pea_observer.node", interrupted=0)


if __name__ == "__main__":
    main()
