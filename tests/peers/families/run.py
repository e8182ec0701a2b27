"""Starts a simulated drive of a family: run.py FAMILY PORT [unprepared]."""

import importlib
import sys

from drive import serve

module = importlib.import_module(sys.argv[1])
serve(module.Drive(unprepared="unprepared" in sys.argv[3:]), int(sys.argv[2]))
