"""`python -m neuido` and the `neuido` command."""

import signal


def run() -> None:
    """Run the command line as a process of its own.

    Until `main` watches the signals, and after it, Ctrl-C ends the process by SIGINT, without the interpreter's traceback.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from neuido.commands.main import main

    main()


if __name__ == "__main__":
    run()
