use super::super::nx::NxOptions;
use super::super::simulated_drive::{DriveOptions, ModelOptions, SimulatedDrive};
use super::*;

struct NxWithBoard {
    drive: SimulatedDrive,
    board: Board,
    now: SimTime,
}

impl NxWithBoard {
    fn new(map: &'static Map) -> NxWithBoard {
        let nx = NxOptions {
            trip_register: true,
            ..NxOptions::default()
        };
        let options = DriveOptions {
            address: 1,
            model: ModelOptions::Nx(nx),
            autopilot: None,
        };
        NxWithBoard {
            drive: SimulatedDrive::new(options, SimTime::ZERO),
            board: Board::new(map, SimTime::ZERO),
            now: SimTime::ZERO,
        }
    }

    /// A board that is identified and whose first report was taken.
    fn ready(map: &'static Map) -> NxWithBoard {
        let mut rig = NxWithBoard::new(map);
        assert_eq!(rig.ask("01F"), "A1061");
        rig.ask("0104");
        while rig.ask("0105") != "A" {}
        rig
    }

    /// The answer to the frame around that text, CRs left out.
    fn ask(&mut self, text: &str) -> String {
        let frame = format!(">{text}{:02X}\r", checksum(text.as_bytes()));
        let (address, command) = Command::decode(frame.as_bytes()).unwrap();
        assert_eq!(address, 1);
        self.command(&command)
    }

    fn command(&mut self, command: &Result<Command, u8>) -> String {
        let mut out = Vec::new();
        let NxWithBoard { drive, board, now } = self;
        board.answer(command, *now, &mut |request| drive.answer(request, *now), &mut out);
        String::from_utf8(out).unwrap().trim_end().to_string()
    }

    fn later(&mut self, time: Duration) {
        self.now += time;
        self.drive.advance(self.now);
    }
}

/// The script of reference/drives.md 6.8, in an order in which the drive reaches its states.
#[test]
fn the_frames_of_the_reference() {
    let mut rig = NxWithBoard::new(&maps::NX);
    assert_eq!(rig.ask("01110203"), "N00");
    assert_eq!(rig.ask("01F"), "A1061");
    assert!(rig.ask("0104").len() > 100, "all there is");
    while rig.ask("0105") != "A" {}
    assert_eq!(rig.ask("01120202"), "A0060");
    assert_eq!(rig.ask("0172030142480000"), "A");
    assert_eq!(rig.ask("01730301"), "A");
    assert_eq!(rig.ask("0172040101"), "A");
    rig.later(Duration::from_secs(10));
    assert_eq!(rig.ask("01110203"), "A41C80000A0", "25 Hz");
    assert_eq!(rig.ask("01120202"), "A4064", "runs");
    rig.board.options.leading_byte = true;
    assert_eq!(rig.ask("01130103"), "A0042480000F2", "50 %");
    rig.board.options.leading_byte = false;
    let trip = RequestPdu::write_register(1998, 53);
    rig.drive.answer(&trip, rig.now);
    assert_eq!(rig.ask("01160102"), "A0035C8");
}

#[test]
fn reports_come_in_pieces_until_they_are_acknowledged() {
    let mut rig = NxWithBoard::new(&maps::NX);
    rig.ask("01F");
    let first = rig.ask("0104");
    assert_eq!(rig.ask("0104"), first, "not acknowledged");
    let mut polls = 1;
    let mut longest = first.len();
    loop {
        let next = rig.ask("0105");
        if next == "A" {
            break;
        }
        polls += 1;
        longest = longest.max(next.len());
        assert_ne!(next, first);
    }
    assert!((2..=16).contains(&polls), "{polls}");
    assert!(longest <= 1 + LONGEST_REPORT + 2);
    assert_eq!(rig.ask("0104"), "A");
    rig.ask("01F");
    assert_eq!(rig.ask("0104"), first, "a full report after each Identify");
    rig.ask("01F");
    assert_eq!(
        rig.ask("0105"),
        first,
        "what was sent before is not what is acknowledged"
    );
    while rig.ask("0105") != "A" {}
    // BI 2 reports its changes after its reports are switched on.
    assert_eq!(rig.ask("0121020101"), "A");
    assert_eq!(rig.ask("0122020101"), "A");
    rig.ask("0104");
    rig.ask("0105");
    assert_eq!(rig.ask("0104"), "A");
    rig.ask("0172040101");
    rig.later(Duration::from_secs(1));
    assert_eq!(rig.ask("0104"), "A20240F8", "region, number, status");
}

#[test]
fn outputs_are_clamped_within_their_type() {
    let mut rig = NxWithBoard::ready(&maps::NX);
    let speed = |value: f32| format!("01720301{:08X}", value.to_bits());
    assert_eq!(rig.ask(&speed(150.0)), "A");
    assert_eq!(rig.ask("01130103"), {
        let digits = format!("{:08X}", 100.0f32.to_bits());
        format!("A{digits}{:02X}", checksum(digits.as_bytes()))
    });
    assert_eq!(rig.ask(&speed(400.0)), "N10");
    assert_eq!(rig.ask(&speed(f32::NAN)), "N10");
    assert_eq!(rig.ask("0172030142"), "N05");
    assert_eq!(rig.ask("0172040102"), "N10", "neither 0 nor 1");
    assert_eq!(rig.ask("01721901"), "N05");
    assert_eq!(rig.ask("0172036342480000"), "N10", "no AO 99");
    assert_eq!(rig.ask("01730401"), "A");
    assert_eq!(rig.ask("0108"), "N01", "no warm reset");
}

#[test]
fn overridden_inputs_fool_the_bus_only() {
    let mut rig = NxWithBoard::ready(&maps::NX);
    assert_eq!(rig.ask("0172020201"), "A");
    assert_eq!(rig.ask("01120202"), "A6066", "state and override");
    assert_eq!(rig.ask("01730202"), "A");
    assert_eq!(rig.ask("01120202"), "A0060");
    rig.ask("0172020201");
    rig.later(MASTER_TIMEOUT + Duration::from_secs(1));
    assert_eq!(rig.ask("01120202"), "A0060", "alone for 10 minutes");
    assert_eq!(rig.ask("017206010007"), "A");
    assert_eq!(rig.ask("01160102"), "A0007C7");
}

#[test]
fn attributes() {
    let mut rig = NxWithBoard::ready(&maps::NX);
    assert_eq!(rig.ask("0121020B42700000"), "A");
    assert_eq!(rig.ask("0111020B"), "A427000008D");
    assert_eq!(rig.ask("01110208"), "A7FC00000B0", "switched off");
    assert_eq!(rig.ask("0121020342700000"), "N11", "a value is overridden");
    assert_eq!(rig.ask("0121020B42"), "N05");
    assert_eq!(rig.ask("01220203"), "N11");
    assert_eq!(rig.ask("0111024D"), "N11");
    assert_eq!(rig.ask("01240103000A"), "A");
    assert_eq!(rig.ask("01140103"), "A000AD1");
    assert_eq!(rig.ask("0100ABC"), "A", "time");
    assert_eq!(rig.ask("0101"), "N01");
    assert_eq!(rig.ask("0177"), "A");
}

#[test]
fn another_board_behaves_otherwise() {
    let mut rig = NxWithBoard::ready(&maps::TECO);
    assert_eq!(rig.ask("0172020201"), "A", "without action");
    assert_eq!(rig.ask("01120202"), "A0060");
    assert_eq!(rig.ask("0121020B42700000"), "N11", "no limits");
    assert_eq!(rig.ask(&format!("01720301{:08X}", 200.0f32.to_bits())), "N10");
    assert_eq!(rig.ask("0108"), "A", "warm reset");
    assert_eq!(rig.ask("01120202"), "N00");
    rig.board.options.nak_checksum = true;
    assert_eq!(rig.ask("01120202"), "N0060");
    assert_eq!(rig.command(&Err(CHECKSUM)), "N0262");
}

#[test]
fn every_object_is_there_once_and_can_be_read() {
    for (map, counts) in [
        (&maps::NX, [23, 15, 10, 16, 1]),
        (&maps::HVX, [23, 11, 8, 13, 1]),
        (&maps::TECO, [10, 24, 22, 12, 0]),
    ] {
        let of = |region| map.entries.iter().filter(|entry| entry.region == region).count();
        assert_eq!(
            [Region::Ai, Region::Bi, Region::Ao, Region::Bo, Region::Adi].map(of),
            counts
        );
        let places: std::collections::BTreeSet<_> = map.entries.iter().map(|e| (e.region, e.number)).collect();
        assert_eq!(places.len(), map.entries.len());
    }
    let mut rig = NxWithBoard::ready(&maps::NX);
    for entry in maps::NX.entries {
        let attribute = entry.region.value_attribute();
        let answer = rig.ask(&format!(
            "011{:X}{:02X}{attribute:02X}",
            entry.region as u8, entry.number
        ));
        assert!(answer.starts_with('A') && answer.len() > 3, "{entry:?}: {answer}");
    }
}
