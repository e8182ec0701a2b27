"""Siemens V20 and G120, PROFIdrive words: word 99, reference 100 (0x4000 = 100 % of P2000), status 109, actual value 110.

Bit 11 turns the motor round. The V20 has its actual values in 23 to 29.
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
        self.holding.update(dict.fromkeys(range(23, 30), 0))
        self.read_only |= set(range(23, 30))

    def show(self):
        super().show()
        self.holding[self.STATUS] |= 0x4000 if self.speed >= 0 else 0
        self.holding[23] = drive.unsigned(self.speed * 50)
        self.holding[24] = drive.unsigned(self.speed * 15)
        self.holding[29] = 540
