"""Schneider Altivar, CiA 402: CMD 8501, LFR 8502 (0.1 Hz), ETA 3201, RFR 3202, RFRD 8604, last fault 7121.

6 shutdown, 7 switch on, 15 enable operation, each only from the state before it; bit 4 of ETA is the mains, bit 15 reverse. Bit 3 off stops by
ramp, bit 2 off is the quick stop, bit 1 off takes the voltage away. Bit 11 turns the motor round, bit 7 resets on its edge.
Settings: tFr 3103, HSP 3104, LSP 3105 (0.1 Hz), ACC 9001, dEC 9002 in steps of Inr 9020, the motor from 9601 on.
"""

import drive

CMD, LFR, ETA = 8501, 8502, 3201
SETTINGS = {
    **{3015: 50, 3103: 600, 3104: 500, 3105: 0, 6005: 100},
    **{8401: 1, 8413: 164, 8423: 20},
    **{9001: 30, 9002: 30, 9020: 1, 9201: 150},
    **{9601: 400, 9602: 500, 9603: 52, 9604: 1420, 9606: 80, 9613: 22, 9622: 52},
}
DISABLED, READY, ON, ENABLED, QUICK, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08


class Drive(drive.Drive):
    FUNCTIONS = {3, 6, 16, 23}
    MOST_READ = 63

    def __init__(self, unprepared=False):
        super().__init__(unprepared)
        self.holding = {CMD: 0, LFR: 0, 8604: 0, 7121: 0, 9630: 0, **dict.fromkeys(range(7201, 7205), 0), **dict.fromkeys(range(3201, 3212), 0)}
        self.holding.update(SETTINGS)
        self.read_only = {8604, 7121, 9630, *range(7201, 7205), *range(3201, 3212)}
        self.state = DISABLED
        self.following = None  # the state at the end of the ramp
        self.word = 0

    def tripped(self):
        self.state, self.following = FAULT, None

    def stopped(self):
        self.state, self.following = DISABLED, None

    def ramp_to(self, state):
        """Operation stays enabled while the motor comes down."""
        self.stop()
        if self.state == ENABLED and self.speed:
            self.following = state
        else:
            self.state = state

    def wrote(self, table, address, value):
        if address == LFR:
            self.target = abs(drive.signed(value)) / 5
        if address == CMD:
            self.command(value)
        if self.direction:
            self.start(self.wanted())

    def wanted(self):
        sign = -1 if drive.signed(self.holding[LFR]) < 0 else 1
        return -sign if self.word & 0x0800 else sign

    def command(self, value):
        before, self.word = self.word, value
        if self.state == FAULT:
            if value & 0x0080 and not before & 0x0080:
                self.reset()
                self.state = DISABLED
            return
        if self.unprepared:
            return
        code = value & 0x0F
        if not value & 0x0002:
            self.coast()
            self.state, self.following = DISABLED, None
        elif not value & 0x0004:
            self.stop()
            self.state = QUICK if self.state == ENABLED else DISABLED
            self.following = None
        elif code == 0x06 and self.state in (DISABLED, READY, ON, ENABLED):
            self.ramp_to(READY)
        elif code == 0x07 and self.state in (READY, ON, ENABLED):
            self.ramp_to(ON)
        elif code == 0x0F and self.state in (ON, ENABLED):
            self.state, self.following = ENABLED, None
            self.start(self.wanted())

    def show(self):
        if self.following and not self.running:
            self.state, self.following = self.following, None
        status = self.state | 0x0210
        status |= 0x0400 if self.at_reference else 0
        status |= 0x8000 if self.speed < 0 else 0
        self.holding[ETA] = status
        self.holding[3202] = drive.unsigned(self.speed * 5)
        self.holding[8604] = drive.unsigned(self.speed * 15)
        self.holding[7121] = 9 if self.faulted else 0
