//! A broadcast of a tool is an order to every drive of the bus, and is ordered among their other orders.

use drivegate_core::event::{Event, EventKind};
use drivegate_core::order::Outcome;
use drivegate_core::process_image::{LeaseAction, Supervision};
use drivegate_model::drive::RawWrites;

use super::*;

const START: [u8; 5] = [6, 0x07, 0xD0, 0, 1];
const STOP: [u8; 5] = [6, 0x07, 0xD0, 0, 0];
const SECOND: Duration = Duration::from_secs(1);

/// A line that the gateway's own polls fill, so that a broadcast waits.
fn busy(seed: u64) -> ToolRig {
    let line = line("vacon-nx", Protocol::ModbusRtu, 19_200, 3);
    let mut tool = ToolRig::new(line, SlotAccess::Raw, seed);
    // A broadcast before: the share of the line is used up.
    assert_eq!(tool.exchange(&frame_of(0, &[6, 0x07, 0xD2, 0x03, 0xE8])), None);
    tool
}

impl ToolRig {
    /// Lets time pass on the line and in the slot.
    fn pass_time(&mut self, time: Duration) {
        let until = self.rig.now + time;
        while self.rig.now < until {
            let due = self.slot.wake_at().unwrap_or(until).min(until).max(self.rig.now);
            self.rig.step(due);
            self.pass(&[]);
        }
    }

    /// Gives an order as another client; returns its answer.
    fn client(&mut self, address: u8, run: f64) -> Outcome {
        let order = self.rig.points(address, &[("run", run)]);
        let mut placed = self.rig.place(address, order);
        loop {
            if let Some(answer) = placed.answer() {
                return answer.outcome;
            }
            self.pass_time(Duration::from_millis(1));
        }
    }

    fn runs(&mut self, address: u8) -> bool {
        self.rig.word(address, 2000) & 1 == 1
    }
}

#[test]
fn no_broadcast_starts_a_drive_behind_a_stop_that_was_acknowledged() {
    for seed in 1..=8 {
        let mut tool = busy(seed);
        tool.pass_time(Duration::from_millis(7 * seed));
        tool.pass(&frame_of(0, &START));
        tool.pass_time(Duration::from_millis(3 * (seed % 4)));
        assert!(tool.client(1, 0.0).is_ok());
        let others = tool.runs(2);
        tool.pass_time(2 * SECOND);
        assert!(!tool.runs(1), "seed {seed}: started behind its stop");
        assert_eq!(tool.runs(2), others, "it went out as a whole, or not at all");
    }
}

#[test]
fn a_broadcast_that_stops_undoes_no_start_that_came_later() {
    for seed in 1..=8 {
        let mut tool = busy(seed);
        tool.pass_time(Duration::from_millis(7 * seed));
        tool.pass(&frame_of(0, &STOP));
        tool.pass_time(Duration::from_millis(3 * (seed % 4)));
        assert!(tool.client(1, 1.0).is_ok());
        tool.pass_time(2 * SECOND);
        assert!(tool.runs(1), "seed {seed}: stopped by what came before its start");
        assert!(!tool.runs(2));
    }
}

#[test]
fn half_a_frame_before_a_stop_is_no_start_behind_it() {
    for whom in [0, 1] {
        let mut tool = busy(3);
        let frame = frame_of(whom, &START);
        tool.pass(&frame[..3]);
        tool.pass_time(Duration::from_millis(20));
        assert!(tool.client(1, 0.0).is_ok());
        tool.pass(&frame[3..]);
        tool.pass_time(2 * SECOND);
        assert!(!tool.runs(1), "the tool began to ask before the stop");
        // The tool repeats its request.
        tool.pass(&frame);
        tool.pass_time(2 * SECOND);
        assert!(tool.runs(1));
    }
}

#[test]
fn a_broadcast_starts_the_lease_of_every_drive_and_is_who_started_it() {
    let mut line = line("vacon-nx", Protocol::ModbusRtu, 38_400, 2);
    line.supervision = Some(Supervision {
        timeout: 2 * SECOND,
        action: LeaseAction::Stop,
        adopt: false,
    });
    let mut tool = ToolRig::new(line, SlotAccess::Raw, 1);
    let mut events = tool.rig.plant.events.subscribe();
    tool.pass(&frame_of(0, &START));
    tool.pass_time(SECOND);
    assert!(tool.runs(1) && tool.runs(2));
    for address in [1, 2] {
        assert!(!tool.rig.drive(address).image.is_unsupervised());
    }
    tool.pass_time(3 * SECOND);
    assert!(!tool.runs(1) && !tool.runs(2), "nobody renewed the lease");
    let events: Vec<Arc<Event>> = std::iter::from_fn(|| events.try_recv().ok()).collect();
    let of = |kind: EventKind| events.iter().filter(move |event| event.kind == kind);
    assert_eq!(of(EventKind::Supervision).count(), 2, "{events:#?}");
    assert_eq!(of(EventKind::Started).count(), 2);
    for started in of(EventKind::Started) {
        assert!(started.text.contains("slot tool"), "{}", started.text);
    }
}

#[test]
fn what_a_broadcast_wrote_of_the_frequency_range_is_not_known_until_it_is_read() {
    let mut line = line("vacon-nx", Protocol::ModbusRtu, 38_400, 1);
    line.spec = |spec| spec.raw_writes = RawWrites::All;
    let mut tool = ToolRig::new(line, SlotAccess::Raw, 1);
    let order = tool.rig.points(1, &[("frequency_reference", 25.0)]);
    tool.pass(&frame_of(0, &[6, 0, 101, 0x13, 0x88]));
    let mut placed = tool.rig.place(1, order);
    while placed.answer().is_none() {
        tool.pass_time(Duration::from_millis(1));
    }
    let outcome = placed.answer().unwrap().outcome;
    assert!(matches!(outcome, Outcome::Refused(_)), "{outcome:?}");
}
