"""The command `jaxmuscle`, also as `python -m jaxmuscle`."""

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the next imports ends in silence

from jaxmuscle.commands.signals import heard


def main() -> None:
    """Entry point of the console script: signals are heard before anything large is imported."""
    with heard():
        from jaxmuscle.commands.main import main as command

        command()


if __name__ == "__main__":
    main()
