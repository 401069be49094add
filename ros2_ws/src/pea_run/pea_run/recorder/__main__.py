"""``ros2 run pea_run recorder``."""

from pea_core.entry import enter


def main() -> None:
    """Run the recorder."""
    enter("pea_run.recorder.node", interrupted=0)


if __name__ == "__main__":
    main()
