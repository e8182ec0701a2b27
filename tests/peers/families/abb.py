"""ABB ACS355, ACS550, ACS580, ABB Drives profile: word 0, reference 1 (20000 = 100 %, sign = direction), status 3.

0x047E prepares, 0x047F runs, bit 7 resets on its rising edge; without bit 10 word and reference are ignored. Group 01 is at
100 + number - 1, the last fault at 400.
"""

import drive
import profidrive


class Drive(profidrive.Drive):
    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding.update({2: 0, 5: 0, 400: 0})
        self.holding.update(dict.fromkeys(range(100, 115), 0))
        self.read_only |= set(range(100, 115)) | {400, 5}

    def show(self):
        super().show()
        self.holding[100] = drive.unsigned(self.speed * 15)
        self.holding[101] = drive.unsigned(abs(self.speed) * 15)
        self.holding[102] = drive.unsigned(abs(self.speed) * 5)
        self.holding[103] = 25 if self.speed else 0
        self.holding[106] = 540
        self.holding[400] = 1 if self.faulted else 0
