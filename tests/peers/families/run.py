"""Starts a simulated drive of a family: run.py FAMILY PORT [unprepared] [slow] [timeout=SECONDS] [set=REGISTER:VALUE]..

`slow` halves the ramp; `timeout` is the drive's own timeout, which counts only writes; `set` is what somebody set at the panel.
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
simulated = module.Drive(unprepared="unprepared" in options)
for option in options:
    if option.startswith("set="):
        register, value = (int(number, 0) for number in option.removeprefix("set=").split(":"))
        assert register in simulated.holding, option
        simulated.holding[register] = value
drive.serve(simulated, int(sys.argv[2]))
