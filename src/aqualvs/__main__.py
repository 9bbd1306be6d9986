"""The program `aqualvs`, also as `python -m aqualvs`."""

import os
import signal
import sys
from types import FrameType


def main() -> int:
    """Run the command line of this process; return the exit code of `aqualvs.cli.main.main`."""
    _open_standard_files()
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, _leave)
    from aqualvs.cli.main import main as run

    if interruptible:
        signal.signal(signal.SIGINT, interrupt)
    return run()


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`; while LLVM works only once that is over.

    Signals that come while LLVM compiles are seen first in the callback with the result. An
    exception there is dropped by ctypes, and the compilation fails for want of the result.
    """
    while frame is not None:
        if str(frame.f_globals.get("__name__")).startswith("llvm"):
            import _thread
            import threading

            soon_s = 0.01
            again = threading.Timer(soon_s, _thread.interrupt_main, (number,))
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _leave(_number: int, _frame: FrameType | None) -> None:
    """End without a traceback while modules are being imported."""
    exit_interrupted = 130
    os.write(2, b"aqualvs: error: interrupted\n")
    os._exit(exit_interrupted)


def _open_standard_files() -> None:
    """Lead standard files that are closed nowhere, or the next file opened takes their number."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


if __name__ == "__main__":
    sys.exit(main())
