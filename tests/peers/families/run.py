"""Starts a simulated drive of a family: run.py FAMILY PORT [unprepared] [slow]."""

import importlib
import sys

import drive

if "slow" in sys.argv[3:]:
    drive.RAMP /= 2
module = importlib.import_module(sys.argv[1])
drive.serve(module.Drive(unprepared="unprepared" in sys.argv[3:]), int(sys.argv[2]))
