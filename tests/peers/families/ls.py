"""LS G100: reference 4 (0.01 Hz), word 5 (bit 0 stop, 1 forward, 2 reverse, each when it is 1; 3 reset, 4 emergency stop),
current 8, frequency 9, voltage 10, status 13 (0 stop, 1 forward, 2 reverse, 3 fault, 4 acc, 5 dec, 6 at speed), trip 14."""

import drive


class Drive(drive.Drive):
    FUNCTIONS = {3, 4, 6, 16}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys(range(4, 15), 0)
        self.read_only = set(range(8, 15))

    def wrote(self, table, address, value):
        if address == 4:
            self.target = value / 50
        if address != 5:
            return
        if value & 0x0008:
            self.reset()
        if value & 0x0010:
            self.coast()
        elif value & 0x0001:
            self.stop()
        elif value & 0x0006 in (2, 4):
            self.start(1 if value & 2 else -1)

    def show(self):
        accelerating = self.direction != 0 and not self.at_reference
        decelerating = self.direction == 0 and self.speed != 0
        forward, reverse = self.running and self.speed >= 0, self.speed < 0
        stopped = not self.running
        self.holding[13] = (
            stopped
            | forward << 1
            | reverse << 2
            | self.faulted << 3
            | accelerating << 4
            | decelerating << 5
            | self.at_reference << 6
        )
        self.holding[9] = drive.unsigned(abs(self.speed) * 50)
