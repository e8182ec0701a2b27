"""Starts a simulated drive of a family: run.py FAMILY PORT [unprepared] [timeout=SECONDS], with its own timeout, which counts writes."""

import importlib
import sys

import drive

for argument in sys.argv[3:]:
    if argument.startswith("timeout="):
        drive.TIMEOUT = float(argument.removeprefix("timeout="))
module = importlib.import_module(sys.argv[1])
drive.serve(module.Drive(unprepared="unprepared" in sys.argv[3:]), int(sys.argv[2]))
