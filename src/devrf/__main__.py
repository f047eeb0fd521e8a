"""`devrf-pipeline` and `python -m devrf`: Ctrl-C is heard from the first moment, not only once all is loaded."""

import os
import signal

STOPPED = 130  # devrf.pipelines.terminal.exit_codes, which is not loaded yet


def main() -> None:
    """Entry point of the console script."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else somebody wants it ignored
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(STOPPED))  # nothing has begun
    from devrf.pipelines.cli.main import main as cli

    cli()


if __name__ == "__main__":
    main()
