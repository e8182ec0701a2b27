"""Danfoss FC profile: word 49999, reference 50009 (0x4000 = 100 %), status 50199, parameter pp-nn at pp nn x 10 - 1.

Bit 10 is data valid; bits 2 to 5 constant 1: bit 2 off DC brake, bit 3 off coast, bit 4 off quick stop, bit 5 off freezes. Bit 6
runs, bit 15 turns the motor round, bit 7 resets on its edge.
"""

import drive

WORD, REFERENCE, STATUS = 49999, 50009, 50199
ACTUAL = 50209
# 1-22 V, 1-23 Hz, 1-25 rpm, 3-41 and 3-42 two words of 0.01 s, 4-12 and 4-14 0.1 Hz.
PARAMETERS = {1219: 400, 1229: 50, 1249: 1420, 3409: 0, 3410: 300, 3419: 0, 3420: 300, 4119: 0, 4139: 500}
READINGS = [ACTUAL, 15009, 15010, 15019, 15020, 16119, 16129, 16299, 16339]


class Drive(drive.Drive):
    FUNCTIONS = {1, 3, 5, 6, 15, 16}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = {WORD: 0, REFERENCE: 0, STATUS: 0, **dict.fromkeys(READINGS, 0), **PARAMETERS}
        self.read_only = {STATUS, *READINGS}
        self.word = 0

    def wrote(self, table, address, value):
        if address == REFERENCE:
            self.target = abs(drive.signed(value)) * 100 / 0x4000
        if address != WORD or not value & 0x0400:
            return
        before, self.word = self.word, value
        if value & 0x0080 and not before & 0x0080:
            self.reset()
        if not value & 0x0008:
            self.coast()
        elif value & 0x0014 != 0x0014 or not value & 0x0040:
            self.stop()
        elif value & 0x0020:
            sign = -1 if drive.signed(self.holding[REFERENCE]) < 0 else 1
            self.start(-sign if value & 0x8000 else sign)

    def show(self):
        coasting = self.unprepared or not self.word & 0x0008
        status = 0x0200
        status |= 0x0003 if not self.faulted and not self.unprepared else 0
        status |= 0x0004 if not coasting else 0
        status |= 0x0008 if self.faulted else 0
        status |= 0x0100 if self.at_reference else 0
        status |= 0x0800 if self.running else 0
        self.holding[STATUS] = status
        self.holding[ACTUAL] = drive.unsigned(self.speed * 0x4000 / 100)
        self.holding[16129] = drive.unsigned(abs(self.speed) * 5)
        self.holding[16299] = 540
