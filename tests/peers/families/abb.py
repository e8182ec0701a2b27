"""ABB ACS355, ACS550, ACS580, ABB Drives profile: word 0, reference 1 (20000 = 100 %, sign = direction), status 3.

0x047E prepares, 0x047F runs, bit 7 resets on its rising edge; without bit 10 word and reference are ignored. Group 01 is at
100 + number - 1, the last fault at 400, parameter ggii at ggii - 1; a 1 to 1607 saves the parameters.
"""

import drive
import profidrive

SAVE = 1607
PARAMETERS = {
    **{1001: 10, 1002: 0, 1102: 0, 1103: 8, 1105: 500, 1106: 2},
    **{2002: 1500, 2007: 0, 2008: 500, 2202: 50, 2203: 50},
    **{3018: 0, 3019: 30, 5302: 1, 5303: 96, 5304: 0, 5305: 2, 9802: 1},
    **{9904: 3, 9905: 400, 9906: 67, 9907: 500, 9908: 1440, 9909: 30},
}


class Drive(profidrive.Drive):
    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding.update({2: 0, 5: 0, 400: 0})
        self.holding.update(dict.fromkeys(range(100, 115), 0))
        self.holding.update({number - 1: value for number, value in PARAMETERS.items()})
        self.holding[SAVE - 1] = 0
        self.read_only |= set(range(100, 115)) | {400, 5}

    def wrote(self, table, address, value):
        super().wrote(table, address, value)
        self.holding[SAVE - 1] = 0  # saving is done at once

    def show(self):
        super().show()
        self.holding[100] = drive.unsigned(self.speed * 15)
        self.holding[101] = drive.unsigned(abs(self.speed) * 15)
        self.holding[102] = drive.unsigned(abs(self.speed) * 5)
        self.holding[103] = 25 if self.speed else 0
        self.holding[106] = 540
        # Overcurrent; 6681 is the lost line of an ACS580.
        self.holding[400] = 0 if not self.faulted else 0x6681 if self.timed_out else 1
