"""The state machine that the ABB Drives profile and PROFIdrive share: off, inhibited, ready, operation.

A word without bit 10 is ignored but for OFF1, OFF2 and OFF3 (bits 0, 1, 2). After power-up and after a trip switching on is
inhibited until bit 0 has fallen. Operation needs bits 0 to 6; bit 3 off inhibits it, bits 4 to 6 off hold the ramp generator.
"""

import drive

OFF = 0x0007
OPERATION = 0x047F


class Drive(drive.Drive):
    WORD = 0
    REFERENCE = 1
    STATUS = 3
    ACTUAL = 4
    FULL = 20000
    REVERSE_BIT = None
    ENABLED = 0x0007

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = {self.WORD: 0, self.REFERENCE: 0, self.STATUS: 0, self.ACTUAL: 0}
        self.read_only = {self.STATUS, self.ACTUAL}
        self.inhibited = True
        self.word = 0

    def tripped(self):
        self.inhibited = True

    def wrote(self, table, address, value):
        if address == self.REFERENCE and self.word & 0x0400:
            self.target = abs(drive.signed(value)) * 100.0 / self.FULL
        if address == self.WORD:
            self.command(value)
        if self.direction:
            self.direction = self.wanted()

    def wanted(self):
        sign = -1 if drive.signed(self.holding[self.REFERENCE]) < 0 else 1
        if self.REVERSE_BIT is not None and self.word >> self.REVERSE_BIT & 1:
            sign = -sign
        return sign

    def command(self, value):
        before = self.word
        if not value & 0x0400:
            # Only what switches off counts.
            value = before & (value | ~OFF)
        self.word = value
        if value & 0x0080 and not before & 0x0080:
            self.reset()
        if not value & 0x0001:
            self.inhibited = self.unprepared or self.faulted or value & 0x0006 != 0x0006
            self.stop()
        if value & 0x0006 != 0x0006:
            self.inhibited = True
            self.coast()
        elif not value & 0x0008:
            self.coast()
        elif value & 0x007F == 0x007F and not self.inhibited and not self.faulted:
            self.target = abs(drive.signed(self.holding[self.REFERENCE])) * 100.0 / self.FULL
            self.start(self.wanted())

    def show(self):
        ready = not self.inhibited and not self.faulted
        on = ready and self.word & 0x0001
        status = 0x0200 | self.word << 3 & 0x0030
        status |= 0x0001 if ready else 0
        status |= 0x0002 if on else 0
        status |= 0x0004 if self.direction or self.speed else 0
        status |= 0x0008 if self.faulted else 0
        status |= 0x0040 if self.inhibited else 0
        status |= 0x0100 if self.at_reference else 0
        self.holding[self.STATUS] = status
        self.holding[self.ACTUAL] = drive.unsigned(self.speed * self.FULL / 100)
