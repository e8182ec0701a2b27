//! A device server that closes its connection: after replies, in mid-transaction, permanently.

use std::time::Duration;

use drivegate_bus::core::Closed;
use drivegate_core::diagnosis::Cause;
use drivegate_core::event::EventKind;
use drivegate_core::order::Outcome;
use drivegate_model::drive::{ModelPoint, State, Value};
use drivegate_proto::Protocol;

use super::bus::{Parts, Seen};
use super::rig::{PATIENCE, Rig, line};

const SECOND: Duration = Duration::from_secs(1);

fn usual() -> [Rig; 3] {
    [
        line("vacon-nx", Protocol::ModbusRtu, 38_400, 2),
        line("teco-7300pa", Protocol::ModbusAscii, 19_200, 2),
        line("vacon-nx-n2", Protocol::N2, 9600, 1),
    ]
    .map(|line| {
        let mut rig = Rig::of(&line);
        for address in 1..=line.drives {
            rig.until_state(address, State::Ready);
        }
        // The points on which commands depend are read, too.
        rig.run(3 * SECOND);
        rig
    })
}

/// Runs the bus until a matching request is on the line, and then closes the connection.
fn close_on(rig: &mut Rig, fits: impl Fn(&Seen) -> bool, lose_reply: bool) -> Closed {
    let until = rig.now + PATIENCE;
    loop {
        let seen = rig.step(until).expect("such a request");
        if seen.iter().any(&fits) {
            return rig.bus.close(lose_reply, rig.now);
        }
    }
}

fn is_over(seen: &Seen) -> bool {
    matches!(seen, Seen::Over(_))
}

fn is_poll(seen: &Seen) -> bool {
    matches!(seen, Seen::Sent(asked) if asked.is_poll)
}

fn is_write(seen: &Seen) -> bool {
    matches!(seen, Seen::Sent(asked) if asked.pdu.is_write())
}

fn events(rig: &Rig, kinds: &[EventKind]) -> usize {
    let recent = rig.plant.events.recent();
    recent.iter().filter(|event| kinds.contains(&event.kind)).count()
}

const PRESENCE: [EventKind; 4] = [
    EventKind::BusDown,
    EventKind::BusUp,
    EventKind::Offline,
    EventKind::Online,
];

#[test]
fn values_and_drives_stay_as_they_are_whenever_the_server_closes() {
    for mut rig in usual() {
        let before = (events(&rig, &PRESENCE), rig.bus.handle.image.health().opened);
        let drives = rig.bus.line.drives;
        let mut bad = 0;
        for turn in 0..300 {
            // The connection closes after the reply, or before it; the reply is then lost, or arrives over the next
            // connection.
            let lose_reply = turn % 12 == 3;
            let closed = match turn % 4 {
                2 | 3 => close_on(&mut rig, is_poll, lose_reply),
                _ => close_on(&mut rig, is_over, false),
            };
            assert_ne!(closed, Closed::Lost, "turn {turn}");
            rig.run(Duration::from_millis(if lose_reply { 600 } else { 100 }));
            assert!(
                (0..usize::from(drives)).all(|drive| rig.is_online(drive)),
                "turn {turn}"
            );
            bad += u32::from((1..=drives).any(|address| rig.state(address) != State::Ready));
        }
        assert!(bad <= 30, "{}: {bad} of 300 looks", rig.bus.line.family);
        let health = rig.bus.handle.image.health();
        assert_eq!(health.reconnects, 300);
        assert_eq!((events(&rig, &PRESENCE), health.opened), (before.0, before.1 + 300));
        assert!(rig.bus.handle.image.health().up);
    }
}

/// A request within 5 ms of a reply enters a connection that the server no longer reads.
#[test]
fn a_server_that_closes_soon_after_each_reply_costs_no_time_of_a_reply() {
    for mut rig in usual() {
        let (drives, began) = (rig.bus.line.drives, rig.now);
        let (mut bad, mut lost) = (0, 0);
        for _ in 0..200 {
            let until = rig.now + PATIENCE;
            let mut heard = false;
            loop {
                let seen = rig.step(until).expect("a reply");
                heard |= seen.iter().any(|seen| matches!(seen, Seen::Heard(_)));
                if heard && seen.iter().any(is_over) {
                    break;
                }
            }
            let asked = |rig: &mut Rig| {
                rig.step(rig.now + Duration::from_millis(5))
                    .is_some_and(|seen| seen.iter().any(is_poll))
            };
            lost += u32::from(asked(&mut rig));
            assert_ne!(rig.bus.close(true, rig.now), Closed::Lost);
            bad += u32::from((1..=drives).any(|address| rig.state(address) != State::Ready));
        }
        let family = &rig.bus.line.family;
        assert!(
            lost <= 10 && bad <= 20,
            "{family}: {lost} of 200 requests, {bad} of 200 looks"
        );
        assert!(
            rig.now - began < 200 * Duration::from_millis(150),
            "{family}: {:?}",
            rig.now - began
        );
    }
}

#[test]
fn orders_survive_the_end_of_a_connection() {
    for mut rig in usual() {
        let order = rig.points(1, &[("run", 1.0)]);
        let mut run = rig.place(1, order);
        // The drive may or may not have received the write, so the write is sent again.
        assert_eq!(close_on(&mut rig, is_write, true), Closed::Reconnect);
        let order = rig.points(1, &[("speed_reference", 30.0)]);
        let mut waits = rig.place(1, order);
        assert!(rig.answered(&mut run).is_ok());
        let outcome = rig.answered(&mut waits);
        assert!(outcome.is_ok(), "what waited is served: {outcome:?}");
        rig.until_good(1, ModelPoint::Running, Value::Bool(true));
        // The reply to the first stop arrives over the next connection, the reply to the second is lost.
        for lose_reply in [false, true] {
            assert!(rig.set(1, &[("run", 1.0)]).is_ok());
            let order = rig.points(1, &[("run", 0.0)]);
            let mut stop = rig.place(1, order);
            let began = rig.now;
            assert_eq!(close_on(&mut rig, is_write, lose_reply), Closed::Reconnect);
            assert!(rig.answered(&mut stop).is_ok());
            assert!(rig.now - began < 3 * SECOND / 2, "{:?}", rig.now - began);
            rig.until_good(1, ModelPoint::Running, Value::Bool(false));
        }
    }
}

#[test]
fn a_write_upon_which_the_server_closes_is_unknown_and_the_line_goes_on() {
    for mut rig in usual() {
        let down = events(&rig, &PRESENCE);
        let order = rig.points(1, &[("run", 1.0)]);
        let mut run = rig.place(1, order);
        let answer = loop {
            if let Some(answer) = run.answer() {
                break answer.outcome;
            }
            let seen = rig.step(rig.now + PATIENCE).expect("something happens");
            if seen.iter().any(is_write) {
                assert_ne!(rig.bus.close(true, rig.now), Closed::Lost);
            }
        };
        assert_eq!(answer, Outcome::TimedOut, "it is unknown whether the drive took it");
        rig.run(5 * SECOND);
        assert_eq!((rig.state(1), events(&rig, &PRESENCE)), (State::Ready, down));
    }
}

#[test]
fn a_server_that_answers_nothing_any_more_is_lost() {
    for mut rig in usual() {
        assert_eq!(close_on(&mut rig, is_over, false), Closed::Reconnect);
        // The line is idle: there is time until the next request.
        assert_eq!(rig.bus.core.closed(rig.now), Closed::ReconnectToAsk);
        rig.bus.core.reconnected();
        assert_eq!(rig.bus.core.closed(rig.now), Closed::Lost, "it takes no request at all");
    }
    for mut rig in usual() {
        assert_eq!(close_on(&mut rig, is_over, false), Closed::Reconnect);
        let is_sent = |seen: &Seen| matches!(seen, Seen::Sent(_));
        assert_eq!(close_on(&mut rig, is_sent, true), Closed::Reconnect);
        assert_eq!(close_on(&mut rig, is_sent, true), Closed::Reconnect);
        assert_eq!(close_on(&mut rig, is_sent, true), Closed::Lost);
        assert_eq!(events(&rig, &[EventKind::BusDown]), 1);
    }
}

/// A server whose patience with a drive that is off is longer, or shorter, than that of the bus.
#[test]
fn a_drive_that_is_off_takes_no_connection_from_the_others() {
    for (mut rig, in_mid_exchange) in usual().into_iter().zip([false, true, false]).take(2) {
        rig.set_alive(2, false);
        rig.until("it is missed", PATIENCE, |rig| !rig.is_online(1));
        for _ in 0..20 {
            let of_dead = |seen: &Seen| matches!(seen, Seen::Sent(asked) if asked.drive == 1);
            let over = |seen: &Seen| matches!(seen, Seen::Over(asked) if asked.drive == 1);
            let closed = if in_mid_exchange {
                close_on(&mut rig, of_dead, true)
            } else {
                close_on(&mut rig, over, false)
            };
            assert_ne!(closed, Closed::Lost);
            assert_eq!(rig.state(1), State::Ready);
        }
    }
}

#[test]
fn a_server_that_closes_all_the_time_is_told_and_nothing_else() {
    for mut rig in usual() {
        let until = rig.now + 60 * SECOND;
        let mut told = Vec::new();
        while rig.now < until {
            close_on(&mut rig, is_over, false);
            rig.run(Duration::from_millis(300));
            let diagnosis = rig.bus.handle.image.diagnosis.load();
            told = diagnosis.verdicts.iter().map(|one| one.verdict).collect();
            assert!(told.iter().all(|cause| *cause == Cause::ConnectionCloses), "{told:?}");
        }
        assert_eq!(told, [Cause::ConnectionCloses], "{}", rig.bus.line.family);
    }
}

/// The learned speed of a line that is faster than its baud rate is kept for the next connection and for the next
/// bus, so that no reply is doubted.
#[test]
fn a_line_that_is_faster_than_its_baud_rate_is_known_after_an_outage() {
    for usual in [
        line("vacon-nx", Protocol::ModbusRtu, 9600, 2),
        line("vacon-nx-n2", Protocol::N2, 9600, 2),
    ] {
        let parts = Parts {
            wire_speed: 12,
            ..Parts::of(0, &usual, 5)
        };
        let mut rig = Rig::recorded(&usual, parts);
        for address in 1..=2 {
            rig.until_state(address, State::Ready);
        }
        rig.run(10 * SECOND);
        for outage in 0..3 {
            if outage == 2 {
                rig.restart();
            } else {
                rig.bus.set_open(false, rig.now);
                rig.run(SECOND);
                rig.bus.set_open(true, rig.now);
            }
            let ready = |rig: &Rig| (1..=2).all(|address| rig.state(address) == State::Ready);
            let took = rig.until("all good again", PATIENCE, ready);
            assert!(took < 1500 * SECOND / 1000, "{} {outage}: {took:?}", usual.family);
        }
    }
}
