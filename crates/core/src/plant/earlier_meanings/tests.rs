//! Reloads that give names and units to other machines, one after the other: an order belongs to the machine that it named, and
//! a client that goes on commanding starts no machine that it did not know.

use super::*;
use crate::order::{Authority, Grants, Origin, Right};
use crate::plant::{OrderRequest, Placed, Plant};
use crate::testkit::{STALE_AFTER, bus, bus_spec, controlled, nx, read, take_next, up};

const SECOND: Duration = Duration::from_secs(1);

/// Name, unit and address of a drive; the address identifies the machine.
type Named = (&'static str, u8, u8);

/// A plant with one bus, which each reload replaces.
struct Reloads {
    buses: Vec<BusHandle>,
    unused: UnusedNames,
    now: Instant,
}

impl Reloads {
    fn new(drives: &[Named]) -> Reloads {
        let mut reloads = Reloads {
            buses: Vec::new(),
            unused: UnusedNames::default(),
            now: Instant::now(),
        };
        reloads.reload(drives);
        reloads
    }

    fn reload(&mut self, drives: &[Named]) {
        self.now += SECOND;
        let image = |(name, unit, address): &Named| {
            let mut spec = controlled(name, "line1", *address, &nx());
            spec.unit = *unit;
            let image = crate::testkit::image(spec);
            read(&image, 2100, &[0x41, 0, 0, 0], self.now);
            image
        };
        let next = up(bus(bus_spec("line1"), drives.iter().map(image).collect()));
        next.take_over(&self.buses, self.now);
        let before = std::mem::replace(&mut self.buses, vec![next]);
        self.unused.follow(&before, &self.buses, self.now);
        self.now += SECOND;
    }

    /// An order of a Modbus TCP client to the drive with this unit, whose first byte arrived at `asked`.
    fn order(&self, unit: u8, run: bool, asked: Instant) -> Placed {
        let plant = Plant::new("g", STALE_AFTER, self.buses.clone());
        let drive = plant.drives().find(|drive| drive.image.spec.unit == unit).unwrap();
        let index = drive.image.spec.profile.model_index(ModelPoint::Run).unwrap();
        let order = Order::Points(vec![(index, Value::Bool(run))]);
        let arrival = Arrival {
            asked,
            ..Arrival::now(self.now)
        };
        let origin = Origin::new(SourceKind::ModbusTcp, "plc");
        let request = OrderRequest::new(order, origin, Authority::Write);
        drive.place(request.within(60 * SECOND).arrived(arrival), self.now)
    }

    /// The address of the machine for which a stop waits.
    fn stopped(&self) -> Option<u8> {
        let stop = take_next(&self.buses[0].queue, self.now)?;
        assert!(stop.is_stop());
        Some(
            self.buses[0]
                .image
                .drives
                .get(stop.intent.target.drive().unwrap())?
                .spec
                .address,
        )
    }
}

fn code(placed: &mut Placed) -> &'static str {
    placed.answer().map_or("waits", |answer| answer.outcome.code())
}

const BOTH: &[Named] = &[("pump-1", 11, 1), ("pump-2", 12, 2)];
const SWAPPED: &[Named] = &[("pump-2", 12, 1), ("pump-1", 11, 2)];
const ONLY_2: &[Named] = &[("pump-2", 12, 2)];
const THIRD: &[Named] = &[("pump-1", 11, 3), ("pump-2", 12, 2)];

/// A controller keeps writing run to unit 11. Columns: the reloads, and the answer to its next run command.
#[test]
fn a_run_command_that_is_repeated_starts_no_machine_that_took_the_place() {
    let table: [(&str, &[&[Named]], &str); 7] = [
        (
            "another drive renamed",
            &[&[("pump-1", 11, 1), ("fan", 13, 2)]],
            "waits",
        ),
        ("swapped", &[SWAPPED], "needs_take"),
        ("swapped, and something else changed", &[SWAPPED, SWAPPED], "needs_take"),
        ("swapped, then a third machine", &[SWAPPED, THIRD], "needs_take"),
        ("removed, then a third machine", &[ONLY_2, THIRD], "needs_take"),
        (
            "removed, then a third machine later",
            &[ONLY_2, ONLY_2, THIRD],
            "needs_take",
        ),
        ("removed and restored", &[ONLY_2, BOTH], "waits"),
    ];
    for (about, reloads, expected) in table {
        let mut plant = Reloads::new(BOTH);
        let mut run = plant.order(11, true, plant.now);
        assert_eq!(code(&mut run), "waits", "{about}");
        for drives in reloads {
            plant.reload(drives);
        }
        let mut again = plant.order(11, true, plant.now);
        assert_eq!(code(&mut again), expected, "{about}");
        if expected == "needs_take" {
            let mut stop = plant.order(11, false, plant.now);
            assert_eq!(code(&mut stop), "waits", "{about}");
            let mut run = plant.order(11, true, plant.now);
            assert_eq!(code(&mut run), "waits", "{about}: after its stop");
        }
    }
}

/// The first byte of an order to unit 11 arrived before the first of these reloads. Columns: the reloads, the answer to a
/// start, and the address of the machine that a stop reaches.
#[test]
fn an_order_belongs_to_the_machine_that_it_named_after_any_number_of_reloads() {
    type Row = (&'static str, &'static [&'static [Named]], &'static str, Option<u8>);
    let table: [Row; 8] = [
        (
            "another drive renamed",
            &[&[("pump-1", 11, 1), ("fan", 13, 2)]],
            "waits",
            Some(1),
        ),
        ("swapped", &[SWAPPED], "unknown_drive", Some(1)),
        (
            "swapped, and something else changed",
            &[SWAPPED, SWAPPED],
            "unknown_drive",
            Some(1),
        ),
        ("swapped twice", &[SWAPPED, BOTH], "unknown_drive", Some(1)),
        (
            "swapped, then a third machine",
            &[SWAPPED, THIRD],
            "unknown_drive",
            None,
        ),
        ("removed, then a third machine", &[ONLY_2, THIRD], "unknown_drive", None),
        ("removed and restored", &[ONLY_2, BOTH], "unknown_drive", Some(1)),
        (
            "renamed, then a third machine",
            &[
                &[("fan", 13, 1), ("pump-2", 12, 2)],
                &[("fan", 13, 1), ("pump-1", 11, 3)],
            ],
            "unknown_drive",
            Some(1),
        ),
    ];
    for (about, reloads, start, stopped) in table {
        let mut plant = Reloads::new(BOTH);
        let asked = plant.now;
        for drives in reloads {
            plant.reload(drives);
        }
        let mut run = plant.order(11, true, asked);
        assert_eq!(code(&mut run), start, "{about}");
        let mut stop = plant.order(11, false, asked);
        let expected = if stopped.is_some() { "waits" } else { "unknown_drive" };
        assert_eq!(code(&mut stop), expected, "{about}");
        assert_eq!(plant.stopped(), stopped, "{about}");
    }
}

/// A NULL of BACnet that changes nothing at the drive counts like a stop, also without `[authority]`.
#[test]
fn a_client_that_gives_its_run_command_back_may_start_the_machine_that_took_the_place() {
    let mut plant = Reloads::new(BOTH);
    let mut run = plant.order(11, true, plant.now);
    assert_eq!(code(&mut run), "waits");
    plant.reload(SWAPPED);
    let drives = Plant::new("g", STALE_AFTER, plant.buses.clone());
    let drive = drives.drives().find(|drive| drive.image.spec.unit == 11).unwrap();
    drive.said_stop(&Origin::new(SourceKind::ModbusTcp, "plc"));
    let mut run = plant.order(11, true, plant.now);
    assert_eq!(code(&mut run), "waits");
}

#[derive(Debug)]
struct On(&'static str);

impl Grants for On {
    fn may_write(&self, bus: &str) -> bool {
        bus == self.0
    }
}

/// A request of a tool at a slot to address 1 began before two buses swapped their ports: its stop reaches the machine that had
/// the address, and a start none.
#[test]
fn a_request_at_a_slot_belongs_to_the_line_that_it_named() {
    let started = Instant::now();
    let (begun, now) = (started + SECOND, started + 2 * SECOND);
    let plant = |ports: [&str; 2]| {
        let one = |(name, port): (&str, &str)| {
            let image = crate::testkit::image(controlled(&format!("{name}-1"), name, 1, &nx()));
            read(&image, 2100, &[0x41, 0, 0, 0], now);
            let mut spec = bus_spec(name);
            spec.port = port.to_string();
            up(bus(spec, vec![image]))
        };
        ["line1", "line2"].into_iter().zip(ports).map(one).collect::<Vec<_>>()
    };
    let (before, after) = (plant(["A", "B"]), plant(["B", "A"]));
    let mut unused = UnusedNames::default();
    unused.follow(&[], &before, started);
    for bus in &after {
        bus.take_over(&before, now);
    }
    unused.follow(&before, &after, now);
    let plant = Plant::new("g", STALE_AFTER, after.clone());
    let of_line1 = plant.drives().find(|drive| drive.image.spec.bus == "line1").unwrap();
    let place = |run: bool, asked: Instant| {
        let index = of_line1.image.spec.profile.model_index(ModelPoint::Run).unwrap();
        let order = Order::Points(vec![(index, Value::Bool(run))]);
        let arrival = Arrival {
            asked,
            ..Arrival::now(now)
        };
        // A slot gives a right on its own bus.
        let right = Right::of(Arc::new(On("line1")));
        let origin = Origin::new(SourceKind::Slot, "tool").with_right(right);
        let request = OrderRequest::new(order, origin, Authority::Write);
        of_line1.place(request.within(60 * SECOND).arrived(arrival), now)
    };
    assert_eq!(code(&mut place(true, begun)), "unknown_drive");
    assert_eq!(code(&mut place(false, begun)), "waits");
    assert!(take_next(&after[0].queue, now).is_none(), "a stop for the other line");
    assert!(take_next(&after[1].queue, now).is_some_and(|stop| stop.is_stop()));
    assert_eq!(code(&mut place(false, now + SECOND)), "waits");
    assert!(take_next(&after[0].queue, now + SECOND).is_some_and(|stop| stop.is_stop()));
}
