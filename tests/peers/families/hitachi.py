"""Hitachi WJ200: coils 0 run, 1 direction (1 = reverse), 2 external trip, 3 reset; reference holding 0, 1 (0.01 Hz, high word
first); coils 14 run, 15 reverse, 16 ready, 19 at speed, 23 alarm; frequency 0x1000, 0x1001. Parameters from 0x1102 (F002, two
words); a 1 to 0x08FF saves them."""

import drive


class Drive(drive.Drive):
    FUNCTIONS = {1, 3, 5, 6, 15, 16}

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([0, 1, 0x1000, 0x1001, 0x1002, *range(0x1010, 0x1019), 0x1025], 0)
        self.parameters = {0x1102: 0, 0x1103: 1000, 0x1104: 0, 0x1105: 1000, 0x1200: 3, 0x1201: 3, 0x1202: 500, 0x1203: 500, 0x135D: 0}
        self.holding.update({**self.parameters, 0x08FF: 0})
        self.coils = dict.fromkeys(range(32), 0)

    def put(self, table, address, value):
        if table == "coil" and address >= 14 or address >= 0x1000 and address not in self.parameters:
            raise drive.Refused(2)
        super().put(table, address, value)

    def wrote(self, table, address, value):
        if table == "holding" and address > 1:
            self.holding[0x08FF] = 0  # saving is done at once
        elif table == "holding":
            self.target = (self.holding[0] << 16 | self.holding[1]) / 50
        if table == "holding":
            return
        if self.coils[2]:
            self.trip()
        if self.coils[3]:
            self.reset()
        if self.coils[0]:
            self.start(-1 if self.coils[1] else 1)
        else:
            self.stop()

    def show(self):
        self.coils[14] = int(self.running)
        self.coils[15] = int(self.speed < 0)
        self.coils[16] = int(not self.faulted and not self.unprepared)
        self.coils[19] = int(self.at_reference)
        self.coils[23] = int(self.faulted)
        self.holding[0x1001] = drive.unsigned(abs(self.speed) * 50)
        self.holding[0x1025] = 5400
