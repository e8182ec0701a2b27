//! Reloads that give device numbers to other machines: a write belongs to the machine that its number meant when the
//! write arrived.

use std::net::SocketAddrV4;

use arc_swap::ArcSwap;
use drivegate_bacnet::encoding::{Reader, Writer};
use drivegate_bacnet::npdu::{self, Payload};
use drivegate_bacnet::{Mac, To, bvlc};
use drivegate_core::plant::{BusHandle, SharedPlant, UnusedNames};
use drivegate_testkit::up;

use super::super::desk::{Desk, Ended};
use super::*;

const HOST: SocketAddrV4 = SocketAddrV4::new(std::net::Ipv4Addr::new(127, 0, 0, 5), 47808);

/// A plant whose bus each reload replaces, and a server without sockets.
struct Reloads {
    plant: SharedPlant,
    unused: UnusedNames,
    server: Loopback,
    now: Instant,
}

/// A bus with drives that have these units and addresses; the output frequency of each is its address in Hz.
fn bus_with(drives: impl Iterator<Item = (u8, u8)>, now: Instant) -> BusHandle {
    let drive = |(unit, address): (u8, u8)| {
        let image = image(DriveSpec {
            unit,
            address,
            name: format!("p{address}"),
            ..spec("vacon-nx")
        });
        read_all(&image, now, |_| u16::from(address) * 100);
        image
    };
    up(bus(bus_spec("line1"), drives.map(drive).collect()))
}

/// The datagram with this APDU for the device of a unit, or for that of the host.
fn datagram(unit: Option<u8>, apdu: &[u8]) -> Vec<u8> {
    let to = unit.map(|unit| (1001, Mac::new(&[unit]).unwrap()));
    bvlc::unicast(&npdu::encode(to, None, true, Payload::Application(apdu)))
}

/// Station of the sender, and APDU.
fn opened(datagram: &[u8]) -> (Option<(u16, Mac)>, Vec<u8>) {
    let Some(bvlc::Bvlc::Unicast(npdu)) = bvlc::decode(datagram) else {
        panic!("{datagram:?}")
    };
    let npdu = npdu::decode(npdu).unwrap();
    let Payload::Application(apdu) = npdu.payload else {
        panic!("{datagram:?}")
    };
    (npdu.from, apdu.to_vec())
}

/// The APDU of a WritePropertyMultiple of run commands at priority 8.
fn runs_at_8(runs: &[(u32, bool)]) -> Vec<u8> {
    let mut writer = Writer::default();
    writer.raw(&[0x00, 0x05, 1, 16]);
    for (number, on) in runs {
        let run = ObjectId::new(ObjectType::BINARY_VALUE, *number);
        writer.context_object(0, run).open(1).context_unsigned(0, 85);
        writer.open(2).enumerated((*on).into()).close(2);
        writer.context_unsigned(3, 8).close(1);
    }
    writer.into_bytes()
}

impl Reloads {
    fn new() -> Reloads {
        Reloads::of(options())
    }

    fn of(options: Options) -> Reloads {
        let now = Instant::now();
        let plant = Plant::new("hall", STALE_AFTER, vec![bus_with([(1, 1), (2, 2)].into_iter(), now)]);
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let mut reloads = Reloads {
            server: Loopback::new(options, plant.clone(), now),
            unused: UnusedNames::default(),
            plant,
            now,
        };
        reloads.server.poll(now);
        reloads.sent();
        reloads
    }

    /// Gives units 1, 2, … to the drives at these addresses.
    fn reload(&mut self, addresses: &[u8]) {
        self.replace_bus((1..).zip(addresses.iter().copied()));
    }

    /// Gives the drive at address 2 unit 3; no drive has unit 2 any more.
    fn move_the_second(&mut self) {
        self.replace_bus([(1, 1), (3, 2)].into_iter());
    }

    fn replace_bus(&mut self, drives: impl Iterator<Item = (u8, u8)>) {
        self.now += Duration::from_millis(10);
        let (before, next) = (self.plant.load_full(), bus_with(drives, self.now));
        next.take_over(&before.buses, self.now);
        let after = vec![next];
        self.unused.follow(&before.buses, &after, self.now);
        self.plant.store(Arc::new(Plant::new("hall", STALE_AFTER, after)));
        self.now += Duration::from_millis(10);
    }

    fn sent(&mut self) -> Vec<Vec<u8>> {
        let to_host = |(to, datagram): (To, Vec<u8>)| (to == To::Host(HOST)).then_some(datagram);
        std::iter::from_fn(|| self.server.transmit())
            .filter_map(to_host)
            .collect()
    }

    /// The APDU that the device of that unit answers a request with; `None` if the answer does not come at once.
    fn ask(&mut self, unit: u8, service: u8, object: ObjectId, content: impl FnOnce(&mut Writer)) -> Option<Vec<u8>> {
        let mut writer = Writer::default();
        writer.context_object(0, object).context_unsigned(1, 85);
        content(&mut writer);
        let apdu = [&[0x00, 0x05, 1, service][..], &writer.into_bytes()].concat();
        self.server.receive(HOST, &datagram(Some(unit), &apdu), self.now);
        Some(opened(&self.sent().pop()?).1)
    }

    fn run_at_8(&mut self, unit: u8, on: bool) -> Option<Vec<u8>> {
        self.ask(unit, 15, RUN, |w| {
            w.open(3).enumerated(on.into()).close(3).context_unsigned(4, 8);
        })
    }

    fn carried_out(&self) -> Option<(u8, bool)> {
        self.next(&done())
    }

    /// Address and run command of the next order in the queue of the bus, which ends so.
    fn next(&self, outcome: &Outcome) -> Option<(u8, bool)> {
        let bus = self.plant.load().buses[0].clone();
        let command = take_next(&bus.queue, self.now)?;
        let drive = bus.image.drives.get(command.intent.target.drive().unwrap())?;
        let order = (drive.spec.address, !command.is_stop());
        command.answer(outcome, self.now);
        Some(order)
    }

    /// Begins a write of `run` at priority 8 to unit 1 that arrived at `asked`, as the present plant understands it.
    fn begun(&self, value: Option<bool>, asked: Instant) -> JobProgress {
        let view = View::new(self.plant.load_full(), Arc::new(options()), HostRights::new(&options()));
        let device = view.devices().into_iter().find(|device| device.instance == DEVICE);
        let job = Job {
            token: 1,
            from: HOST.to_string().parse().unwrap(),
            device: DEVICE,
            place: device.unwrap().find(RUN).unwrap(),
            object: RUN,
            value: value.map(Datum::Bool),
            priority: Some(8),
            requested_at: asked,
            since: asked,
        };
        writes::begin(&view, &job, Arrival::now(asked), self.now)
    }

    fn drive(&self, name: &str) -> DriveHandle {
        self.plant.load().drive(name).unwrap()
    }

    /// A client at another address has `run` of a drive inactive at priority 3.
    fn protect(&self, drive: &str) {
        let origin = Origin::new(SourceKind::Bacnet, "127.0.0.7:47808");
        let entry = drivegate_core::order::Entry::new(Value::Bool(false), origin, self.now);
        self.drive(drive)
            .priorities(|all| all.restore(Commanded::Run, 3, entry));
    }
}

#[test]
fn what_arrives_behind_a_reload_reaches_the_machine_that_the_number_means_now() {
    let mut plant = Reloads::new();
    let frequency = ObjectId::new(ObjectType::ANALOG_INPUT, 2);
    let read = |plant: &mut Reloads| {
        let answer = plant.ask(1, 12, frequency, |_| {}).unwrap();
        let mut reader = Reader::new(&answer[3..]);
        reader.context_object(0).unwrap();
        reader.context_property(1).unwrap();
        reader.open(3).unwrap();
        reader.data().unwrap()
    };
    assert_eq!(read(&mut plant), Some(Data::Real(1.0)));
    // The periodic work of the server, 100 ms apart, is not due between the reloads and the requests.
    plant.reload(&[2, 1]);
    assert_eq!(plant.run_at_8(1, false), None, "it waits for the drive");
    assert_eq!(plant.carried_out(), Some((2, false)));
    assert_eq!(plant.carried_out(), None);
    plant.server.collect(plant.now);
    assert_eq!(plant.sent().len(), 1, "the acknowledgement");
    plant.reload(&[1, 2]);
    assert_eq!(read(&mut plant), Some(Data::Real(1.0)));
    plant.reload(&[2, 1]);
    assert_eq!(read(&mut plant), Some(Data::Real(2.0)));
}

#[test]
fn what_arrived_before_a_reload_reaches_the_machine_that_it_named_and_no_slot() {
    let mut plant = Reloads::new();
    plant.run_at_8(1, true);
    assert_eq!(plant.next(&done()), Some((1, true)));
    plant.server.collect(plant.now);
    let before = plant.now;
    plant.reload(&[2, 1]);
    plant.protect("p2");
    let slots = |plant: &Reloads, drive| {
        let entry = |all: &mut drivegate_core::permit::Priorities| all.entry(Commanded::Run, 8).is_some();
        plant.drive(drive).priorities(entry)
    };
    // At the machine that has the number now, an inactive at 8 and a NULL would follow nothing.
    for stop in [Some(false), None] {
        let JobProgress::Waits(waiting) = plant.begun(stop, before) else {
            panic!("a stop waits for its drive")
        };
        assert_eq!(plant.carried_out(), Some((1, false)), "{stop:?}");
        assert_eq!(waiting.slot, None);
        assert!(
            !slots(&plant, "p1") && !slots(&plant, "p2"),
            "an active would start the motor later"
        );
    }
    let denied = |begun| matches!(begun, JobProgress::Answered(Err(Error::WRITE_ACCESS_DENIED)));
    assert!(denied(plant.begun(Some(true), before)));
    // Where the slots of the named machine make it no stop, nothing reaches either machine.
    plant.protect("p1");
    assert!(denied(plant.begun(Some(false), before)));
    assert_eq!(plant.carried_out(), None);
    assert!(!slots(&plant, "p1") && !slots(&plant, "p2"));
}

#[test]
fn numbers_of_new_options_count_with_the_plant_of_the_same_reload() {
    let mut plant = Reloads::new();
    let (rights, at) = (HostRights::new(&options()), (options().listen, 8));
    let mut desk = Desk::new(Arc::new(options()), rights.clone(), plant.plant.clone(), at, plant.now);
    let numbers = |desk: &Desk| {
        let name = |(number, drive): (&u32, &super::super::view::ShownDrive)| {
            let name = drive.handle.image.spec.name.clone();
            (*number, name)
        };
        let mut all: Vec<_> = desk.view.drives.iter().map(name).collect();
        all.sort();
        all
    };
    let of = |first: u32, names: [&str; 2]| [(first, names[0].to_string()), (first + 1, names[1].to_string())];
    let renumbered = Options {
        device: 200,
        ..options()
    };
    rights.set(Some(&renumbered));
    desk.poll(plant.now);
    assert_eq!(numbers(&desk), of(101, ["p1", "p2"]));
    plant.reload(&[2, 1]);
    desk.poll(plant.now);
    assert_eq!(numbers(&desk), of(201, ["p2", "p1"]));
    rights.set(None);
    plant.reload(&[1, 2]);
    desk.poll(plant.now);
    assert_eq!(
        numbers(&desk),
        of(201, ["p1", "p2"]),
        "a server that ends keeps its options"
    );
}

#[test]
fn a_slot_that_waits_for_a_reading_waits_for_that_of_its_machine() {
    let mut plant = Reloads::new();
    plant.run_at_8(1, false);
    assert_eq!(plant.next(&Outcome::TimedOut), Some((1, false)));
    plant.server.collect(plant.now);
    let stands = |plant: &Reloads| {
        let entry = |all: &mut drivegate_core::permit::Priorities| all.entry(Commanded::Run, 8).is_some();
        plant.drive("p1").priorities(entry)
    };
    plant.server.poll(plant.now);
    assert!(!stands(&plant));
    plant.reload(&[2, 1]);
    plant.server.poll(plant.now);
    assert!(stands(&plant), "the drive was read since, and shows the stop");
}

#[test]
fn leases_are_counted_by_machine() {
    let plant = Reloads::new();
    let holds = Some(drivegate_core::process_image::Supervision {
        timeout: Duration::from_secs(5),
        action: drivegate_core::process_image::LeaseAction::LeaveRunning,
        adopt: false,
    });
    let drive = |unit: u8| {
        image(DriveSpec {
            unit,
            address: unit,
            name: format!("p{unit}"),
            supervision: holds.clone(),
            ..spec("vacon-nx")
        })
    };
    let bus = up(bus(bus_spec("line1"), vec![drive(1), drive(2)]));
    let stored = || Arc::new(Plant::new("hall", STALE_AFTER, vec![bus.clone()]));
    plant.plant.store(stored());
    let (rights, at) = (HostRights::new(&options()), (options().listen, 8));
    let mut desk = Desk::new(Arc::new(options()), rights.clone(), plant.plant.clone(), at, plant.now);
    plant.drive("p2").image.count_supervision();
    desk.poll(plant.now);
    plant.protect("p2");
    let stands = |plant: &Reloads| {
        plant
            .drive("p2")
            .priorities(|all| all.entry(Commanded::Run, 3).is_some())
    };
    // The second drive gets the number that the first one had.
    rights.set(Some(&Options {
        device: 99,
        ..options()
    }));
    plant.plant.store(stored());
    desk.poll(plant.now);
    assert!(stands(&plant), "no lease has ended");
    plant.drive("p2").image.count_supervision();
    desk.poll(plant.now);
    assert!(!stands(&plant));
}

#[test]
fn the_later_stops_of_a_request_go_to_their_machines_under_whatever_number() {
    let flat = Options {
        network: None,
        ..options()
    };
    let second = Mac::new(&[2]).map(|station| (1001, station));
    // Both drives in the single device, where the last stop goes first; the second one as a device, with a start before its
    // stop.
    let requests = [
        (flat, None, [(2001, false), (1001, false)], (1, false), None),
        (options(), Some(2), [(1, true), (1, false)], (2, true), second),
    ];
    for (options, unit, runs, first, station) in requests {
        let mut plant = Reloads::of(options);
        plant
            .server
            .receive(HOST, &datagram(unit, &runs_at_8(&runs)), plant.now);
        let bus = plant.plant.load().buses[0].clone();
        let on_the_line = take_next(&bus.queue, plant.now).expect("an order");
        let address = bus.image.drives.get(on_the_line.drive().unwrap()).unwrap().spec.address;
        assert_eq!((address, !on_the_line.is_stop()), first);
        plant.move_the_second();
        on_the_line.answer(&done(), plant.now);
        plant.server.collect(plant.now);
        assert_eq!(plant.sent(), Vec::<Vec<u8>>::new());
        assert_eq!(plant.carried_out(), Some((2, false)));
        plant.server.collect(plant.now);
        let sent = plant.sent();
        assert_eq!(
            sent.iter().map(|sent| opened(sent)).collect::<Vec<_>>(),
            [(station, vec![0x20, 1, 16])]
        );
    }
}

#[test]
fn to_a_number_that_no_drive_has_now_only_a_stop_from_before_is_carried_out() {
    let flat = Options {
        network: None,
        ..options()
    };
    for (options, unit, run) in [(options(), Some(2), 1), (flat, None, 2001)] {
        let mut plant = Reloads::new();
        let (rights, at) = (HostRights::new(&options), (options.listen, 8));
        let mut desk = Desk::new(Arc::new(options), rights, plant.plant.clone(), at, plant.now);
        let before = plant.now;
        plant.move_the_second();
        for (asked, on, stops) in [(before, true, false), (before, false, true), (plant.now, false, false)] {
            desk.received(Arrival::now(asked), plant.now);
            desk.receive(HOST, &datagram(unit, &runs_at_8(&[(run, on)])), plant.now);
            let waiting = desk.next_order(plant.now);
            assert_eq!(waiting.is_some(), stops, "{unit:?} {on}");
            assert_eq!(plant.carried_out(), stops.then_some((2, false)), "{unit:?} {on}");
            if let Some((token, mut waiting)) = waiting {
                assert_eq!(waiting.slot, None);
                let outcome = waiting.placed.answer().unwrap().outcome;
                desk.ended(&Ended::of(token, waiting, outcome), plant.now);
            }
        }
    }
}

#[test]
fn a_later_stop_goes_to_its_machine_although_the_numbers_have_changed() {
    let mut plant = Reloads::new();
    let (rights, at) = (HostRights::new(&options()), (options().listen, 8));
    let mut desk = Desk::new(Arc::new(options()), rights.clone(), plant.plant.clone(), at, plant.now);
    let request = datagram(Some(2), &runs_at_8(&[(1, true), (1, false)]));
    desk.receive(HOST, &request, plant.now);
    let (token, mut waiting) = desk.next_order(plant.now).expect("the start");
    assert_eq!(plant.carried_out(), Some((2, true)));
    // The drive with unit 1 gets number 102.
    let renumbered = Options {
        device: 101,
        ..options()
    };
    rights.set(Some(&renumbered));
    plant.move_the_second();
    let outcome = waiting.placed.answer().unwrap().outcome;
    desk.ended(&Ended::of(token, waiting, outcome), plant.now);
    assert!(desk.next_order(plant.now).is_some());
    assert_eq!((plant.carried_out(), plant.carried_out()), (Some((2, false)), None));
}
