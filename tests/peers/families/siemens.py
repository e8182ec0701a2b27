"""Siemens V20 and G120, PROFIdrive words: word 99, reference 100 (0x4000 = 100 % of P2000), status 109, actual value 110.

Bit 11 turns the motor round. The V20 has its actual values in 23 to 29, the output voltage in 32, its faults from 54 on, and
settings from 0 on: watchdog, its reaction, 9 current limit (0.1 %), 10 and 11 ramps (0.01 s), 15 P2000 (0.01 Hz).
"""

import drive
import profidrive


class Drive(profidrive.Drive):
    WORD = 99
    REFERENCE = 100
    STATUS = 109
    ACTUAL = 110
    FULL = 0x4000
    REVERSE_BIT = 11

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        readings = {*range(23, 30), 32, *range(53, 58)}
        self.holding.update(dict.fromkeys(readings, 0))
        self.holding.update({0: 0, 1: 0, 9: 1500, 10: 1000, 11: 1000, 15: 5000})
        self.read_only |= readings

    def show(self):
        super().show()
        self.holding[self.STATUS] |= 0x4000 if self.speed >= 0 else 0
        self.holding[23] = drive.unsigned(self.speed * 50)
        self.holding[24] = drive.unsigned(self.speed * 15)
        self.holding[29] = 540
        self.holding[54] = 1 if self.faulted else self.holding[54]
