"""`python -m mpipic`, and `mpipic`, are the command line."""

from mpipic.interrupts import end_when_asked


def main() -> None:
    """Run the command line, which signals can end from before its libraries are there."""
    end_when_asked()
    from mpipic.cli import main as command_line

    command_line()


if __name__ == "__main__":
    main()
