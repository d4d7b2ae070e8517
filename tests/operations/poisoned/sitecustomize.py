"""Ends every process that opens one match file, as the system does when memory runs out."""

import os
import signal
import sys

POISON = f"{os.sep}poisoned{os.sep}pitch.json"


def end(event, arguments):
    if event == "open" and str(arguments[0]).endswith(POISON):
        os.kill(os.getpid(), signal.SIGKILL)


sys.addaudithook(end)
