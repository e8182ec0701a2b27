//! The server without sockets: in virtual time, without a runtime.

use std::sync::Arc;
use std::time::{Duration, Instant};

use arc_swap::ArcSwap;
use drivegate_core::order::{Authority, Command, Order};
use drivegate_core::permit::{Mode, Principal, Rules};
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_model::drive::ModelPoint;
use drivegate_north::NorthState;
use drivegate_north::modbus_tcp::Loopback;
use drivegate_proto::{RequestPdu, Table};
use drivegate_testkit::take_next;

use super::rig::{acknowledge, frame, n2_plant, options, plant, registers, words};
use super::views::write_and_read;

struct OfflineClient {
    plant: SharedPlant,
    stats: Arc<NorthState>,
    client: Loopback,
    now: Instant,
}

impl OfflineClient {
    fn of(plant: Plant) -> OfflineClient {
        let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
        let peer = ([10, 0, 0, 9], 4711).into();
        let stats = Arc::new(NorthState::default());
        OfflineClient {
            client: Loopback::new(options(), plant.clone(), stats.clone(), peer, Authority::Write),
            plant,
            stats,
            // A time in the future, which no clock of this machine has reached.
            now: Instant::now() + Duration::from_secs(600),
        }
    }

    fn pop(&self) -> Option<Command> {
        take_next(&self.plant.load().buses[0].queue, self.now)
    }

    /// The drive takes the next order, which this gives.
    fn serve(&self) -> Order {
        let command = self.pop().unwrap();
        let (order, outcome) = (command.intent.order.clone(), acknowledge(&command));
        command.ticket.answer(outcome, self.now);
        order
    }

    fn receive(&mut self, bytes: &[u8]) -> Vec<u8> {
        self.client.receive(bytes, self.now)
    }
}

#[test]
fn orders_are_queued_when_the_call_returns_and_end_by_the_time_that_is_told() {
    let mut session = OfflineClient::of(plant());
    let mut batch = frame(1, 1, &words(6, &[0x8101, 1000]));
    batch.extend(frame(2, 1, &words(6, &[0x8100, 1])));
    batch.extend(frame(3, 1, &words(3, &[2102, 1])));
    let read = frame(3, 1, &registers(3, &[5000]));
    assert_eq!(session.receive(&batch), read, "the process image answers at once");
    assert_eq!(session.plant.load().buses[0].queue.lock().len(), 2);
    let first = session.pop().unwrap();
    assert_eq!(first.ticket.client(), "modbus_tcp 10.0.0.9");
    assert_eq!(first.intent.window.expires, session.now + Duration::from_secs(2));
    let outcome = acknowledge(&first);
    first.ticket.answer(outcome, session.now);
    assert_eq!(session.receive(&[]), frame(1, 1, &words(6, &[0x8101, 1000])));
    session.now += Duration::from_secs(2);
    assert!(session.pop().is_none());
    assert_eq!(session.receive(&[]), frame(2, 1, &[0x86, 0x0B]));
    assert!(!session.client.is_waiting());
}

#[test]
fn the_next_piece_of_a_read_is_queued_when_the_last_one_is_finished() {
    let mut session = OfflineClient::of(n2_plant());
    assert!(session.receive(&frame(7, 1, &words(2, &[5, 4]))).is_empty());
    let piece = |start| Order::Read(RequestPdu::read(Table::DiscreteInput, start, 1));
    assert_eq!(session.serve(), piece(7));
    assert!(session.pop().is_none(), "one at a time");
    session.now += Duration::from_secs(1);
    assert!(session.receive(&[]).is_empty());
    let second = session.pop().unwrap();
    assert_eq!(second.intent.order, piece(8));
    assert_eq!(
        second.intent.window.expires,
        session.now + Duration::from_secs(2),
        "each has its own time"
    );
    let outcome = acknowledge(&second);
    second.ticket.answer(outcome, session.now);
    assert_eq!(session.receive(&[]), frame(7, 1, &[2, 1, 0b0011]));
}

#[test]
fn clients_of_one_server_share_the_command_word() {
    let mut session = OfflineClient::of(plant());
    let mut other = session
        .client
        .beside(([10, 0, 0, 10], 4711).into(), None, Authority::Write);
    session.receive(&frame(1, 1, &words(6, &[0x8100, 0])));
    session.serve();
    let reset = frame(2, 1, &words(6, &[0x8100, 4]));
    session.receive(&reset);
    for points in [2, 1] {
        let Order::Points(part) = session.serve() else {
            panic!("a command")
        };
        assert_eq!(part.len(), points, "the stop, then the reset");
    }
    assert!(other.receive(&reset, session.now).is_empty());
    let second = session.pop().unwrap();
    assert_eq!(second.ticket.client(), "modbus_tcp 10.0.0.10");
    let Order::Points(second) = second.intent.order else {
        panic!("a command")
    };
    assert_eq!(second.len(), 2);
    assert!(session.pop().is_none(), "the reset was given by the first client");
}

#[test]
fn a_start_that_arrives_in_pieces_does_not_run_behind_a_stop() {
    let mut session = OfflineClient::of(plant());
    let mut other = session
        .client
        .beside(([10, 0, 0, 8], 4711).into(), None, Authority::Write);
    // Over the model and raw: the stop comes between the two halves.
    for start in [&[0x8100, 1][..], &[2000, 1]] {
        let start = frame(7, 1, &words(6, start));
        let refused = [0, 7, 0, 0, 0, 3, 1, 0x86, 6];
        for cut in [1, 6, 11] {
            assert!(session.receive(&start[..cut]).is_empty());
            session.now += Duration::from_millis(20);
            assert!(
                other
                    .receive(&frame(8, 1, &words(6, &[0x8100, 0])), session.now)
                    .is_empty()
            );
            session.serve();
            assert!(!other.receive(&[], session.now).is_empty(), "acknowledged");
            session.now += Duration::from_millis(20);
            assert_eq!(session.receive(&start[cut..]), refused, "{cut}");
        }
        // When it is sent again, the request is accepted; the next one in the same piece has its own time.
        session.now += Duration::from_millis(20);
        assert!(session.receive(&start[..3]).is_empty());
        session.now += Duration::from_millis(20);
        assert!(session.receive(&start[3..]).is_empty());
        session.serve();
        assert_eq!(session.receive(&[]), start);
    }
}

/// Exception 02 in answer to function 23.
const NO_SUCH_REGISTER: [u8; 2] = [0x97, 2];

impl OfflineClient {
    /// The answer to the request of a client, which comes at once.
    fn ask(&mut self, unit: u8, pdu: &[u8]) -> Vec<u8> {
        let answer = self.receive(&frame(1, unit, pdu));
        answer.get(7..).unwrap_or_default().to_vec()
    }

    /// Whether the orders that wait reset a fault. All are carried out.
    fn resets(&self) -> bool {
        let plant = self.plant.load();
        let reset = plant
            .drives()
            .next()
            .unwrap()
            .image
            .spec
            .profile
            .model_index(ModelPoint::FaultReset);
        let of_order = |order: &Order| matches!(order, Order::Points(values) if values.iter().any(|(index, _)| Some(*index) == reset));
        let mut resets = false;
        while let Some(command) = self.pop() {
            resets |= of_order(&command.intent.order);
            let outcome = acknowledge(&command);
            command.ticket.answer(outcome, self.now);
        }
        resets
    }
}

/// A principal with this name and rank for a client at this address.
fn principal(name: &str, rank: usize, address: &str) -> Principal {
    Principal {
        modbus_tcp: vec![address.parse().unwrap()],
        ..Principal::new(name, rank)
    }
}

#[test]
fn of_a_write_whose_read_is_refused_only_a_stop_counts() {
    let mut session = OfflineClient::of(plant());
    let drive = session.plant.load().drive("pump-1").unwrap();
    // No hold is taken or broken, and no heartbeat is counted.
    let rules = Rules {
        mode: Mode::Exclusive,
        ranks: ["site", "plant"].map(Into::into).to_vec(),
        lease: Duration::from_secs(30),
        stop_at_local: false,
        principals: vec![
            principal("scada", 0, "10.0.0.9/32"),
            principal("plc", 1, "10.0.0.10/32"),
        ],
    };
    drive.bus.queue.set_authority(Some(Arc::new(rules)));
    let holder = |session: &OfflineClient| drive.hold_view(None, session.now).unwrap().0.holder;
    let mut plc = session
        .client
        .beside(([10, 0, 0, 10], 4711).into(), None, Authority::Write);
    plc.receive(&frame(1, 1, &words(6, &[0x8104, 1])), session.now);
    assert_eq!(holder(&session).as_deref(), Some("plc"));
    drive.image.take_heartbeat();
    let bad_read = |write| write_and_read(write, (0x9000, 1));
    for write in [(0x8104, &[2][..]), (0x8103, &[7]), (0x8103, &[7, 2])] {
        assert_eq!(session.ask(1, &bad_read(write)), NO_SUCH_REGISTER, "{write:?}");
    }
    assert_eq!(holder(&session).as_deref(), Some("plc"));
    assert_eq!(
        session.ask(1, &write_and_read((0x8104, &[2]), (0x8013, 1))),
        [23, 2, 0, 1]
    );
    assert_eq!(holder(&session).as_deref(), Some("scada"));
    drive.image.take_heartbeat();
    assert_eq!(session.ask(1, &bad_read((0x8103, &[7]))), NO_SUCH_REGISTER);
    assert_eq!(drive.image.take_heartbeat(), None);
    session.ask(1, &write_and_read((0x8103, &[7]), (0x8013, 1)));
    assert!(drive.image.take_heartbeat().is_some());
    // The reset bit is not stored, so that it is a change when it is written again.
    drive.bus.queue.set_authority(None);
    session.receive(&frame(1, 1, &words(6, &[0x8100, 1])));
    assert!(!session.resets());
    session.receive(&[]);
    assert_eq!(session.ask(1, &bad_read((0x8100, &[5]))), NO_SUCH_REGISTER);
    assert!(session.pop().is_none());
    session.receive(&frame(2, 1, &words(6, &[0x8100, 5])));
    assert!(session.resets());
    session.receive(&[]);
    // A raw write, too, only stops.
    let raw = write_and_read((2000, &[0, 0, 5000]), (0x9000, 1));
    assert!(session.receive(&frame(3, 1, &raw)).is_empty(), "it waits for the drive");
    assert_eq!(session.serve(), Order::Write(RequestPdu::write_register(2000, 0)));
    assert!(session.pop().is_none());
    assert_eq!(session.receive(&[]), frame(3, 1, &NO_SUCH_REGISTER));
}

#[test]
fn function_23_stops_all_like_other_writes() {
    let mut session = OfflineClient::of(n2_plant());
    let both = write_and_read((0x0100, &[1]), (0x0000, 1));
    assert!(
        session.receive(&frame(1, 255, &both)).is_empty(),
        "it waits for the drive"
    );
    let mut stopped = 0;
    while let Some(command) = session.pop() {
        assert!(command.is_stop());
        stopped += 1;
        let outcome = acknowledge(&command);
        command.ticket.answer(outcome, session.now);
    }
    assert!(stopped > 0);
    session.stats.stop_all.advance(&session.plant.load(), session.now);
    assert_eq!(session.receive(&[]), frame(1, 255, &NO_SUCH_REGISTER));
    let no_stop = write_and_read((0x0100, &[2]), (0x0000, 1));
    assert_eq!(session.ask(255, &no_stop), [0x97, 3]);
}
