"""Toshiba VF-S15: word 0xFA00 (bits 15 and 14 take command and reference, 13 resets, 12 emergency off, 11 coast, 10 run, 9
reverse), reference 0xFA01 (0.01 Hz), frequency 0xFD00, status 0xFD01, trip 0xFC90. One register a read."""

import drive


class Drive(drive.Drive):
    MOST_READ = 1

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0xFA00, 0xFA01, 0xFC90, 0xFC91, 0xFD00, 0xFD01], 0)
        self.read_only = {0xFC90, 0xFC91, 0xFD00, 0xFD01}
        self.word = 0

    def wrote(self, table, address, value):
        if address == 0xFA01:
            self.target = value / 50
        if address != 0xFA00:
            return
        before, self.word = self.word, value
        if value & 0x2000 and not before & 0x2000:
            self.reset()
        if value & 0x1000:
            self.trip()
        elif value & 0x0800:
            self.coast()
        elif value & 0x8400 == 0x8400:
            self.start(-1 if value & 0x0200 else 1)
        else:
            # Without bit 15 the terminals command, and nothing is wired to them.
            self.stop()

    def show(self):
        standby = not self.faulted and not self.unprepared
        self.holding[0xFD00] = drive.unsigned(abs(self.speed) * 50)
        self.holding[0xFD01] = self.faulted << 1 | (self.speed < 0) << 9 | self.running << 10 | standby << 14
        self.holding[0xFC90] = 1 if self.faulted else 0
