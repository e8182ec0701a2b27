"""Yaskawa V1000, A1000: word 1, reference 2 (0.01 Hz), status 0x2C and 0x4B, monitors 0x40..0x46, fault 0x80.

Bit 0 forward, bit 1 reverse; both are no run command. Bit 2 is an external fault, bit 3 resets. One register is written by
function 16, too.
"""

import drive


class Drive(drive.Drive):
    FUNCTIONS = {3, 8, 16}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([1, 2, *range(0x20, 0x50), 0x7F, 0x80], 0)
        self.read_only = set(range(0x20, 0x81))
        self.word = 0

    def wrote(self, table, address, value):
        if address == 2:
            self.target = value / 50
        if address != 1:
            return
        before, self.word = self.word, value
        if value & 0x0004:
            self.trip()
        run = value & 0x0003
        # A reset needs the run command away.
        if value & 0x0008 and not before & 0x0008 and not run:
            self.reset()
        if run in (1, 2):
            self.start(1 if run == 1 else -1)
        else:
            self.stop()

    def show(self):
        ready = not self.faulted and not self.unprepared
        common = self.running | (self.speed == 0) << 1
        self.holding[0x2C] = common | self.at_reference << 2 | ready << 6 | self.faulted << 14
        self.holding[0x4B] = common | (self.speed < 0) << 2 | self.at_reference << 4 | ready << 5 | self.faulted << 7
        self.holding[0x41] = drive.unsigned(abs(self.speed) * 50)
        self.holding[0x46] = 540
        self.holding[0x80] = 7 if self.faulted else 0
