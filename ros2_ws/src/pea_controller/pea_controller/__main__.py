"""``ros2 run pea_controller controller``."""

from pea_core.entry import enter


def main() -> None:
    """Run the node."""
    enter("pea_controller.node", interrupted=0)


if __name__ == "__main__":
    main()
