"""The command `quadexp`, and `python -m quadexp`."""

from quadexp.cli.early import listen


def main() -> None:
    """Entry point; the slow imports come after the handlers of signals."""
    listen()
    from quadexp.cli.app import main as run

    run()


if __name__ == "__main__":
    main()
