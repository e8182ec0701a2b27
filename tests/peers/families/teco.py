"""TECO F510: word 0x2501 (bit 0 run, 1 reverse, 2 external fault, 3 reset), reference 0x2502 (0.01 Hz), status 0x2520 (0 run, 1
reverse, 2 ready, 3 fault, 4 warning, 5 zero, 7 at speed, 13, 14 not from the bus), fault 0x2521, frequency 0x2524."""

import drive


class Drive(drive.Drive):
    MOST_READ = 35

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0x2501, 0x2502, *range(0x2520, 0x2529)], 0)
        self.read_only = set(range(0x2520, 0x2529))
        self.word = 0

    def wrote(self, table, address, value):
        if address == 0x2502:
            self.target = value / 50
        if address != 0x2501:
            return
        before, self.word = self.word, value
        if value & 0x0004:
            self.trip()
        if value & 0x0008 and not before & 0x0008 and not value & 1:
            self.reset()
        if value & 0x0001:
            self.start(-1 if value & 2 else 1)
        else:
            self.stop()

    def show(self):
        ready = not self.faulted and not self.unprepared
        self.holding[0x2520] = (
            self.running | (self.speed < 0) << 1 | ready << 2 | self.faulted << 3 | (self.speed == 0) << 5 | self.at_reference << 7
        )
        self.holding[0x2521] = 2 if self.faulted else 0
        self.holding[0x2524] = drive.unsigned(abs(self.speed) * 50)
