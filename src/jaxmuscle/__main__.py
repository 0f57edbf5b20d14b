"""The command `jaxmuscle`, also as `python -m jaxmuscle`."""

import gc
import os
import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the next imports ends in silence

from jaxmuscle.commands.signals import heard


def main() -> None:
    """Entry point of the console script: signals are heard before anything large is imported."""
    # A fit's matrices are small: OpenBLAS's other threads would spin between them, for half as long
    # as the fit computes.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    # Searches and chains take one tiny step after the other: XLA's threads would spin between them.
    # Many seeds need them.
    if command in ("fit", "compare", "posterior") and not any(
        word.startswith("--seeds") for word in sys.argv
    ):
        os.environ.setdefault("PJRT_NPROC", "1")
    # what is imported and loaded stays: to look through it again and again is of no use
    gc.set_threshold(50_000)
    with heard():
        from jaxmuscle.commands.main import main as command

        command()


if __name__ == "__main__":
    main()
