"""Invertek Optidrive E2, P2: word 0 (bit 0 run, 1 second ramp, 2 reset, 3 coast), reference 1 (0.1 Hz), status 5 (low byte 0
running, 1 tripped, 5 standby, 6 ready; high byte fault), frequency 6, current 7, power 9, DC link 22, heatsink 23."""

import drive


class Drive(drive.Drive):
    FUNCTIONS = {3, 6}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0, 1, 2, 3, 5, 6, 7, 8, 9, 22, 23], 0)
        self.read_only = {5, 6, 7, 8, 9, 22, 23}
        self.word = 0

    def wrote(self, table, address, value):
        if address == 1:
            self.target = abs(drive.signed(value)) / 5
        if address != 0:
            return
        before, self.word = self.word, value
        if value & 0x0004 and not before & 0x0004:
            self.reset()
        # Coast goes before the fast stop, and that before a run command.
        if value & 0x0008:
            self.coast()
        elif value & 0x0002:
            self.stop()
        elif value & 0x0001:
            self.start(-1 if drive.signed(self.holding[1]) < 0 else 1)
        else:
            self.stop()

    def show(self):
        ready = not self.faulted and not self.unprepared
        self.holding[5] = self.running | self.faulted << 1 | ready << 6 | (3 << 8 if self.faulted else 0)
        self.holding[6] = drive.unsigned(self.speed * 5)
        self.holding[22] = 540
