"""What the shell starts. Ctrl-C ends it with one line, even while libraries are loading."""

from pixcal_cli.interrupted import leave


def main() -> None:
    """Entry point of the shell command."""
    try:
        import signal  # here: it takes a while itself

        heard = signal.getsignal(signal.SIGINT)  # ignored, if a shell starts us in the background
        if heard is signal.default_int_handler:
            # An exception would pass through half-loaded libraries.
            signal.signal(signal.SIGINT, leave)
        from pixcal_cli.main import main as run

        signal.signal(signal.SIGINT, heard)
        run()
    except KeyboardInterrupt:
        leave()


if __name__ == "__main__":
    main()
