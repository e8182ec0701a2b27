"""WEG CFW: word 682 (P0682), reference 683 (8192 = synchronous speed), status 680, actual speed 681.

Bits 0 run and 1 general enable both, 2 direction (1 forward), 4 remote; bit 1 off coasts, bit 6 quick stop; bit 7 resets on its
edge; bit 3 jogs. Status: 8 running, 10 direction, 12 remote, 13 undervoltage, 15 fault. Parameter Pnnnn is register nnnn.
"""

import drive

PARAMETERS = {
    **{100: 200, 101: 200, 102: 50, 103: 50},  # ramps, 0.1 s
    **{133: 30, 134: 660, 135: 106, 156: 78, 157: 71, 158: 46},  # 0.1 Hz, 0.1 A
    **{220: 2, 221: 0, 222: 9, 223: 2, 224: 1, 225: 1, 226: 4, 227: 2, 228: 2},
    **{308: 1, 310: 1, 311: 1, 312: 2, 313: 1, 314: 50},
    **{400: 400, 401: 71, 402: 1720, 403: 60, 404: 8, 407: 80},  # V, 0.1 A, rpm, Hz, code, 0.01
}


class Drive(drive.Drive):
    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = dict.fromkeys([*range(2, 11), 48, 49, 50, 60, 70, 680, 681, 682, 683], 0)
        self.read_only = {*range(2, 11), 48, 49, 50, 60, 70, 680, 681}
        self.holding.update(PARAMETERS)
        self.word = 0

    def wrote(self, table, address, value):
        if address == 683:
            self.target = abs(drive.signed(value)) * 100 / 8192
        if address != 682:
            return
        before, self.word = self.word, value
        if value & 0x0080 and not before & 0x0080:
            self.reset()
        if not value & 0x0002:
            self.coast()
        elif value & 0x0013 == 0x0013 and not value & 0x0040:
            self.start(1 if value & 0x0004 else -1)
        else:
            self.stop()

    def show(self):
        forward = self.speed >= 0
        remote = self.word >> 4 & 1
        self.holding[680] = self.running << 8 | forward << 10 | remote << 12 | self.unprepared << 13 | self.faulted << 15
        self.holding[681] = drive.unsigned(self.speed * 81.92)
        self.holding[5] = drive.unsigned(abs(self.speed) * 5)
        self.holding[49] = 70 if self.faulted else 0
