//! Whether an order still means the machine that it named when its first byte arrived.
//!
//! This rule is checked before an order enters the queue ([`crate::plant::DriveHandle::place`]), since all other
//! rules judge the machine that the order reaches. It is not checked again: a bus serves the same machines as long
//! as it runs, and a reload ends the waiting orders of a bus that it replaces, or hands them over by machine.

use crate::order::Refusal;

/// The refusal of all orders except stops.
pub fn refusal() -> Refusal {
    Refusal::UnknownDrive(
        "the name meant another machine when this request began; nothing was written; send it again".to_string(),
    )
}

/// The refusal of a stop of several drives for one of them that a reload took out of reach while the request arrived:
/// removed, or no longer controlled.
pub fn out_of_reach(is_removed: bool) -> Refusal {
    if is_removed {
        Refusal::UnknownDrive("a reload removed the drive while the request arrived".to_string())
    } else {
        Refusal::NotAllowed("a reload took its access = \"control\" away while the request arrived".to_string())
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use crate::order::{Arrival, Authority, Order, Origin, SourceKind};
    use crate::plant::{BusHandle, OrderRequest, Plant, UnusedNames};
    use crate::testkit::{STALE_AFTER, bus, bus_spec, controlled, image, nx, read, take_next, up};
    use drivegate_model::drive::{ModelPoint, Value};
    use drivegate_proto::{RequestPdu, Table};

    const SECOND: Duration = Duration::from_secs(1);

    /// A bus with these drives: name, unit id, and the address, which is the machine.
    fn with(drives: &[(&str, u8, u8)], now: Instant) -> BusHandle {
        let drives = drives.iter().map(|(name, unit, address)| {
            let mut spec = controlled(name, "line1", *address, &nx());
            spec.unit = *unit;
            let image = image(spec);
            read(&image, 2100, &[0x41, 0, 0, 0], now);
            image
        });
        up(bus(bus_spec("line1"), drives.collect()))
    }

    fn order(what: &str) -> Order {
        let (point, value) = match what {
            "start" => (ModelPoint::Run, Value::Bool(true)),
            "stop" => (ModelPoint::Run, Value::Bool(false)),
            "reset" => (ModelPoint::FaultReset, Value::Bool(true)),
            "reference" => (ModelPoint::SpeedReference, Value::Number(20.0)),
            _ => {
                return Order::Read(RequestPdu::Read {
                    table: Table::Holding,
                    start: 100,
                    count: 1,
                });
            }
        };
        Order::Points(vec![(nx().model_index(point).unwrap(), value)])
    }

    /// An order to `pump`, unit 11, which meant machine 1 until a reload.
    #[test]
    fn an_order_reaches_the_machine_that_it_named_or_none() {
        use SourceKind::{Bacnet, CommandLine, Http, LocalSocket, ModbusTcp, Mqtt, Slot, Sparkplug};
        let swapped: &[(&str, u8, u8)] = &[("fan", 12, 1), ("pump", 11, 2)];
        let renamed: &[(&str, u8, u8)] = &[("pump", 12, 1), ("fan", 11, 2)];
        let removed: &[(&str, u8, u8)] = &[("pump", 11, 2)];
        let unchanged: &[(&str, u8, u8)] = &[("pump", 11, 1), ("fan", 12, 2)];
        // The drives after the reload, whether the first byte came before it, the way in, the order, and what becomes of it:
        // the machine that it reaches, or the code of its refusal.
        let table = [
            (unchanged, true, Http, "start", "1"),
            (swapped, true, Http, "start", "unknown_drive"),
            (swapped, true, Http, "reference", "unknown_drive"),
            (swapped, true, Http, "reset", "unknown_drive"),
            (swapped, true, Http, "read", "unknown_drive"),
            (swapped, true, Http, "stop", "1"),
            (swapped, false, Http, "start", "2"),
            (swapped, false, Http, "stop", "2"),
            (swapped, true, Mqtt, "start", "unknown_drive"),
            (swapped, true, Sparkplug, "start", "unknown_drive"),
            (swapped, true, LocalSocket, "start", "unknown_drive"),
            (swapped, true, ModbusTcp, "start", "unknown_drive"),
            (swapped, true, ModbusTcp, "read", "unknown_drive"),
            (swapped, true, ModbusTcp, "stop", "1"),
            (swapped, true, Bacnet, "start", "unknown_drive"),
            (swapped, true, Bacnet, "stop", "1"),
            // A tool and a command without a gateway name their machine by its address.
            (swapped, true, Slot, "start", "2"),
            (swapped, true, CommandLine, "start", "2"),
            // A name was kept and its unit id was not: each way in counts what it uses.
            (renamed, true, Http, "start", "1"),
            (renamed, true, ModbusTcp, "start", "unknown_drive"),
            (renamed, true, ModbusTcp, "stop", "1"),
            (removed, true, Http, "start", "unknown_drive"),
            (removed, true, Http, "stop", "unknown_drive"),
            (removed, true, ModbusTcp, "stop", "unknown_drive"),
        ];
        for (after, is_old, kind, what, expected) in table {
            let start = Instant::now();
            let before = with(unchanged, start);
            let next = with(after, start + SECOND);
            next.take_over(std::slice::from_ref(&before), start + SECOND);
            UnusedNames::default().follow(&[before], std::slice::from_ref(&next), start + SECOND);
            let now = start + 2 * SECOND;
            let plant = Plant::new("g", STALE_AFTER, vec![next.clone()]);
            let by_unit = matches!(kind, ModbusTcp | Bacnet);
            let is_named = |name: &str, unit: u8| if by_unit { unit == 11 } else { name == "pump" };
            let drive = plant
                .drives()
                .find(|drive| is_named(&drive.image.spec.name, drive.image.spec.unit))
                .unwrap();
            let arrival = Arrival {
                asked: if is_old { start } else { now },
                ..Arrival::now(now)
            };
            let request = OrderRequest::new(order(what), Origin::new(kind, "c"), Authority::Write);
            let mut placed = drive.place(request.within(60 * SECOND).arrived(arrival), now);
            let reached = match placed.answer() {
                Some(answer) => answer.outcome.code().to_string(),
                None => {
                    let command = take_next(&next.queue, now).unwrap();
                    let machine = next.image.drives.get(command.drive().unwrap()).unwrap();
                    machine.spec.address.to_string()
                }
            };
            assert_eq!(
                reached, expected,
                "{what} of {kind:?} to {after:?}, begun before: {is_old}"
            );
            assert!(
                take_next(&next.queue, now).is_none(),
                "{what} of {kind:?} reached another machine too"
            );
        }
    }
}
