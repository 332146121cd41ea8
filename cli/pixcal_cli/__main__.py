"""What the shell starts: Ctrl-C ends it in one line, also while the libraries are still loading."""

import os


def _leave(*_: object) -> None:
    # At once: nothing has begun, and an exception would pass through half-loaded libraries.
    os.write(2, b"pixcal: interrupted; run the same command again to resume\n")
    os._exit(1)


def main() -> None:
    """Entry point of the shell command."""
    try:
        import signal  # here: it takes a while itself

        heard = signal.getsignal(signal.SIGINT)  # ignored, if a shell starts us in the background
        if heard is signal.default_int_handler:
            signal.signal(signal.SIGINT, _leave)
        from pixcal_cli.main import main as run

        signal.signal(signal.SIGINT, heard)
        run()
    except KeyboardInterrupt:
        _leave()


if __name__ == "__main__":
    main()
