//! The status words of the families, written by hand from their manuals without using the profiles.

use super::reactions::is;
use drivegate_model::drive::profile::Part;

/// The state that a status word shows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shows {
    /// The number of steps of the start sequence that are completed.
    pub(super) position: usize,
    pub(super) running: bool,
    /// Whether a run command is in effect. If not, a running motor decelerates.
    pub(super) commanded: bool,
    /// The direction that was last ordered.
    pub(super) ordered_reverse: bool,
    /// The direction in which the motor turns, or is about to turn.
    pub(super) turns_reverse: bool,
    pub(super) at_reference: bool,
    pub(super) standing: bool,
    pub(super) fault: u16,
    pub(super) remote: bool,
    /// The control word in force.
    pub(super) word: u16,
}

impl Shows {
    fn faulted(&self) -> bool {
        self.fault != 0
    }

    /// A run command would start the motor.
    fn ready(&self) -> bool {
        !self.faulted()
    }

    fn forward(&self) -> bool {
        self.running && !self.turns_reverse
    }

    fn reverse(&self) -> bool {
        self.running && self.turns_reverse
    }

    fn accelerating(&self) -> bool {
        self.running && self.commanded && !self.at_reference
    }

    fn decelerating(&self) -> bool {
        self.running && !self.commanded
    }
}

/// Holding registers by PDU address, with the parts of their content.
pub(super) type Words = Vec<(u16, Part)>;

/// All bits of a register, with whether each is on.
fn word(address: u16, bits: &[(u8, bool)]) -> Words {
    let on = bits.iter().filter(|(_, on)| *on);
    let value = on.fold(0, |word, (bit, _)| word | 1u16 << bit);
    vec![(address, Part { mask: u16::MAX, value })]
}

/// The bits that many families share: 0 ready to switch on, 1 ready, 2 operation, 3 fault, 4 and 5 OFF2 and OFF3
/// inactive, 6 switching on inhibited, 9 remote.
fn off_bits(shows: &Shows) -> Vec<(u8, bool)> {
    let ready = shows.position > 0 && shows.ready();
    vec![
        (0, ready),
        (1, ready && is(shows.word, 0x0001)),
        (2, shows.running),
        (3, shows.faulted()),
        (4, is(shows.word, 0x0002)),
        (5, is(shows.word, 0x0004)),
        (6, shows.position == 0),
        (8, shows.at_reference),
        (9, shows.remote),
    ]
}

pub(super) fn abb(shows: &Shows) -> Words {
    word(3, &off_bits(shows))
}

/// Bit 14: clockwise.
pub(super) fn profidrive(shows: &Shows) -> Words {
    let bits = [off_bits(shows), vec![(14, !shows.turns_reverse)]].concat();
    word(109, &bits)
}

/// Bits 0 and 1 ready, 2 not coasting, 3 trip, 8 at reference, 9 auto, 11 running.
pub(super) fn danfoss(shows: &Shows) -> Words {
    let bits = [
        (0, shows.ready()),
        (1, shows.ready()),
        (2, is(shows.word, 0x0008)),
        (3, shows.faulted()),
        (8, shows.at_reference),
        (9, shows.remote),
        (11, shows.running),
    ];
    word(50_199, &bits)
}

/// The states of CiA 402, bit 4 mains, 9 remote, 10 at reference, 15 reverse.
pub(super) fn cia402(shows: &Shows) -> Words {
    let state: u16 = match shows.position {
        _ if shows.faulted() => 0x0008,
        _ if shows.running => 0x0027,
        0 => 0x0040,
        1 => 0x0021,
        _ => 0x0023,
    };
    let bits = [
        (4, true),
        (9, shows.remote),
        (10, shows.at_reference),
        (15, shows.turns_reverse),
    ];
    let with_state = |(address, part): (u16, Part)| {
        let value = part.value | state;
        (address, Part { value, ..part })
    };
    word(3201, &bits).into_iter().map(with_state).collect()
}

/// 0x2C: 0 run, 1 zero speed, 2 speed agree, 6 ready, 14 fault. 0x4B, U1-12: 0 run, 1 zero speed, 2 reverse, 4 speed agree,
/// 5 ready, 7 fault.
pub(super) fn yaskawa(shows: &Shows) -> Words {
    let state = word(
        0x2C,
        &[
            (0, shows.running),
            (1, shows.standing),
            (2, shows.at_reference),
            (6, shows.ready()),
            (14, shows.faulted()),
        ],
    );
    let status = word(
        0x4B,
        &[
            (0, shows.running),
            (1, shows.standing),
            (2, shows.turns_reverse),
            (4, shows.at_reference),
            (5, shows.ready()),
            (7, shows.faulted()),
        ],
    );
    [state, status].concat()
}

/// Status of a Delta at 0x2101: bits 1 and 0 are 00 stopped, 01 stopping, 11 running; bit 4 is the ordered
/// direction, bit 3 the actual one; bit 10 means that run commands come from the bus.
pub(super) fn delta(shows: &Shows) -> Words {
    let turns = if shows.standing {
        shows.ordered_reverse
    } else {
        shows.turns_reverse
    };
    let bits = [
        (0, shows.running),
        (1, shows.running && shows.commanded),
        (3, turns),
        (4, shows.ordered_reverse),
        (10, shows.remote),
    ];
    word(0x2101, &bits)
}

/// 1 forward, 2 reverse, 3 stopped, 4 fault.
pub(super) fn invt(shows: &Shows) -> Words {
    let code = match () {
        () if shows.faulted() => 4,
        () if shows.reverse() => 2,
        () if shows.running => 1,
        () => 3,
    };
    let mask = u16::MAX;
    vec![(0x2100, Part { mask, value: code })]
}

/// Bits 0 run, 1 forward, 2 reverse, 3 at speed, 7 fault.
pub(super) fn mitsubishi(shows: &Shows) -> Words {
    let bits = [
        (0, shows.running),
        (1, shows.forward()),
        (2, shows.reverse()),
        (3, shows.at_reference),
        (7, shows.faulted()),
    ];
    word(8, &bits)
}

/// Bits 0 running, 1 tripped, 6 ready; the high byte is the fault.
pub(super) fn invertek(shows: &Shows) -> Words {
    let bits = [(0, shows.running), (1, shows.faulted()), (6, shows.ready())];
    let with_fault = |(address, part): (u16, Part)| {
        let value = part.value | (shows.fault & 0x00FF) << 8;
        (address, Part { value, ..part })
    };
    word(5, &bits).into_iter().map(with_fault).collect()
}

/// P0680: bits 8 running, 10 forward, 12 remote as ordered, 15 fault.
pub(super) fn weg(shows: &Shows) -> Words {
    let bits = [
        (8, shows.running),
        (10, !shows.turns_reverse),
        (12, shows.remote && is(shows.word, 0x0010)),
        (15, shows.faulted()),
    ];
    word(680, &bits)
}

/// M14: bits 0 forward, 1 reverse, 3 output off, 5 DC link up, 9 accelerating, 10 decelerating, 11 alarm, 12 bus valid.
pub(super) fn fuji(shows: &Shows) -> Words {
    let bits = [
        (0, shows.forward()),
        (1, shows.reverse()),
        (3, !shows.running),
        (5, true),
        (9, shows.accelerating()),
        (10, shows.decelerating()),
        (11, shows.faulted()),
        (12, shows.remote),
    ];
    word(0x080E, &bits)
}

/// Bits 1 tripped, 9 reverse, 10 running, 14 standby.
pub(super) fn toshiba(shows: &Shows) -> Words {
    let bits = [
        (1, shows.faulted()),
        (9, shows.turns_reverse),
        (10, shows.running),
        (14, shows.ready()),
    ];
    word(0xFD01, &bits)
}

/// Bits 0 stop, 1 forward, 2 reverse, 3 fault, 4 accelerating, 5 decelerating, 6 at speed.
pub(super) fn ls(shows: &Shows) -> Words {
    let bits = [
        (0, !shows.running),
        (1, shows.forward()),
        (2, shows.reverse()),
        (3, shows.faulted()),
        (4, shows.accelerating()),
        (5, shows.decelerating()),
        (6, shows.at_reference),
    ];
    word(13, &bits)
}

/// Bits 0 run, 1 reverse, 2 ready, 3 fault, 5 zero speed, 7 at speed, 13 and 14 reference and run not from the bus.
pub(super) fn teco(shows: &Shows) -> Words {
    let bits = [
        (0, shows.running),
        (1, shows.turns_reverse),
        (2, shows.ready()),
        (3, shows.faulted()),
        (5, shows.standing),
        (7, shows.at_reference),
        (13, !shows.remote),
        (14, !shows.remote),
    ];
    word(0x2520, &bits)
}

/// Bits 0 ready, 1 run, 2 reverse, 3 fault, 5 at reference, 6 zero speed.
pub(super) fn vacon(shows: &Shows) -> Words {
    let bits = [
        (0, shows.ready()),
        (1, shows.running),
        (2, shows.turns_reverse),
        (3, shows.faulted()),
        (5, shows.at_reference),
        (6, shows.standing),
    ];
    word(2100, &bits)
}
