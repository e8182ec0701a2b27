"""Fuji FRENIC: command S06 0x0706, reference S05 0x0705 (0.01 Hz, signed), status M14 0x080E, frequency M09 0x0809.

Bit 0 forward, bit 1 reverse, rising bit 15 resets: with a run command standing the motor starts then. Unused codes of a group
read 0.
"""

import drive


class Drive(drive.Drive):
    MOST_READ = MOST_WRITE = 50

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0x0705, 0x0706, *range(0x0801, 0x0830)], 0)
        self.read_only = set(range(0x0801, 0x0830))
        self.word = 0

    def wrote(self, table, address, value):
        if address == 0x0705:
            self.target = abs(drive.signed(value)) / 50
        if address != 0x0706:
            return
        before, self.word = self.word, value
        if value & 0x8000 and not before & 0x8000:
            self.reset()
        run = value & 0x0003
        if run in (1, 2):
            self.start(1 if run == 1 else -1)
        else:
            self.stop()

    def show(self):
        off = not self.running
        link = not self.unprepared
        forward, reverse = self.running and self.speed >= 0, self.speed < 0
        accelerating = self.direction != 0 and not self.at_reference
        decelerating = self.direction == 0 and self.speed != 0
        self.holding[0x080E] = (
            forward | reverse << 1 | off << 3 | link << 5 | accelerating << 9 | decelerating << 10 | self.faulted << 11 | 1 << 12
        )
        self.holding[0x0809] = drive.unsigned(self.speed * 50)
        self.holding[0x0810] = 1 if self.faulted else 0
