"""Vacon 10: word 2000 (bit 0 run, 1 reverse, 2 reset), reference 2002 (0.01 %), status 2100 as Vacon NX (0 ready, 1 run, 2
reverse, 3 fault, 4 warning, 5 at reference, 6 zero speed), monitors 2103 to 2110. Parameters: ID - 1."""

import drive


class Drive(drive.Drive):
    FUNCTIONS = {3, 4, 6, 16}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([*range(2000, 2011), *range(2100, 2111)], 0)
        self.holding.update({100: 0, 101: 5000, 102: 30, 103: 30, 107: 0, 108: 0, 116: 3, 171: 3, 599: 0, 600: 60})
        self.read_only = set(range(2100, 2111))
        self.inputs = {7: 35}
        self.word = 0

    def wrote(self, table, address, value):
        if address == 2002:
            self.target = value / 100
        if address != 2000:
            return
        before, self.word = self.word, value
        if value & 4 and not before & 4:
            self.reset()
        if value & 1:
            self.start(-1 if value & 2 else 1)
        else:
            self.stop()

    def show(self):
        ready = not self.faulted and not self.unprepared
        self.holding[2100] = (
            ready | self.running << 1 | (self.speed < 0) << 2 | self.faulted << 3 | self.at_reference << 5 | (self.speed == 0) << 6
        )
        self.holding[2103] = drive.unsigned(abs(self.speed) * 50)
        self.holding[2110] = 1 if self.faulted else 0
