"""Mitsubishi D700: word 8 (bit 1 forward, bit 2 reverse), which reads the status; reference 13 (0.01 Hz).

Status: bit 0 run, 1 forward, 2 reverse, 3 at speed, 7 fault. A write of register 1
restarts it.
"""

import drive


class Drive(drive.Drive):
    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([1, 8, 13, 200, 201, 202, 207, 213, *range(500, 508)], 0)
        self.read_only = {200, 201, 202, 207, 213, *range(500, 508)}

    def wrote(self, table, address, value):
        if address == 1:
            self.coast()
            self.reset()
        elif address == 13:
            self.target = value / 50
        elif address == 8:
            run = value >> 1 & 3
            if run in (1, 2):
                self.start(1 if run == 1 else -1)
            else:
                self.stop()

    def show(self):
        forward, reverse = self.running and self.speed >= 0, self.speed < 0
        self.holding[8] = self.running | forward << 1 | reverse << 2 | self.at_reference << 3 | self.faulted << 7
        self.holding[200] = drive.unsigned(abs(self.speed) * 50)
        self.holding[500] = 0x10 if self.faulted else 0
