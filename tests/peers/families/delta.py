"""Delta MS300: word 0x2000, reference 0x2001 (0.01 Hz), 0x2002 reset (bit 1; bit 0 external fault, bit 2 base block).

Bits 1 and 0: 01 stop, 10 run; bits 5 and 4: 01 forward, 10 reverse. A code acts when it is written: 0 does nothing. Status 0x2100
(low byte fault) and 0x2101 (1..0 state, 4..3 00 forward, 11 reverse, 01 to forward, 10 to reverse, 10 bus). As on the MH300,
0x2001 and 0x2002 cannot be read. Parameters: group x 256 + number.
"""

import drive


class Drive(drive.Drive):
    MOST_READ = MOST_WRITE = 20

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0x2000, 0x2001, 0x2002, *range(0x2100, 0x2110)], 0)
        self.holding.update({0x0100: 6000, 0x0101: 5000, 0x0102: 4000, 0x0107: 0, 0x010A: 5000, 0x010B: 0})
        self.holding.update({**dict.fromkeys(range(0x010C, 0x0114), 1000), 0x0902: 3, 0x0903: 0})
        self.read_only = set(range(0x2100, 0x2110))
        self.write_only = {0x2001, 0x2002}
        self.facing = 1

    def wrote(self, table, address, value):
        if address == 0x2001:
            self.target = value / 50
        elif address == 0x2002:
            if value & 1:
                self.trip()
            if value & 2:
                self.reset()
            if value & 4:
                self.coast()
        elif address == 0x2000:
            facing = value >> 4 & 3
            if facing in (1, 2):
                self.facing = 1 if facing == 1 else -1
            if value & 3 == 2:
                self.start(self.facing)
            elif value & 3 == 1:
                self.stop()

    def show(self):
        state = 3 if self.direction else 1 if self.speed else 0
        self.holding[0x2100] = 4 if self.faulted else 0
        turns = self.speed or self.facing
        self.holding[0x2101] = state | (turns < 0) << 3 | (self.facing < 0) << 4 | 1 << 10
        self.holding[0x2102] = self.holding[0x2001]
        self.holding[0x2103] = drive.unsigned(abs(self.speed) * 50)
        self.holding[0x2105] = 5400
