"""INVT Goodrive: word 0x2000 (1 forward, 2 reverse, 5 stop, 6 coast, 7 reset; each acts when written), reference 0x2001
(0.01 Hz), state 0x2100 (1 forward, 2 reverse, 3 stop, 4 fault), fault 0x2102, monitors 0x3000.. Parameters: group x 256 + number."""

import drive


class Drive(drive.Drive):
    MOST_READ = MOST_WRITE = 16

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0x2000, 0x2001, 0x2100, 0x2101, 0x2102, *range(0x3000, 0x3008)], 0)
        # P00.01 to P00.12 in the order of their numbers, and the timeout of the line.
        self.holding.update({0x0001: 2, 0x0002: 0, 0x0003: 5000, 0x0006: 8, 0x000B: 100, 0x000C: 100, 0x0E04: 0})
        self.read_only = {0x2100, 0x2101, 0x2102, *range(0x3000, 0x3008)}

    def wrote(self, table, address, value):
        if address == 0x2001:
            self.target = value / 50
        elif address == 0x2000:
            {1: lambda: self.start(1), 2: lambda: self.start(-1), 5: self.stop, 6: self.coast, 7: self.reset}.get(
                value, lambda: None
            )()

    def show(self):
        turning = 1 if self.speed > 0 or self.direction > 0 else 2
        self.holding[0x2100] = 4 if self.faulted else turning if self.running else 3
        self.holding[0x2102] = 4 if self.faulted else 0
        self.holding[0x3000] = drive.unsigned(abs(self.speed) * 50)
