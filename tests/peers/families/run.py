"""Starts a simulated drive of a family: run.py FAMILY PORT [unprepared] [slow] [timeout=SECONDS].

`slow` halves the ramp; `timeout` is the drive's own timeout, which counts only writes.
"""

import importlib
import sys

import drive

options = sys.argv[3:]
if "slow" in options:
    drive.RAMP /= 2
for option in options:
    if option.startswith("timeout="):
        drive.TIMEOUT = float(option.removeprefix("timeout="))
module = importlib.import_module(sys.argv[1])
drive.serve(module.Drive(unprepared="unprepared" in options), int(sys.argv[2]))
