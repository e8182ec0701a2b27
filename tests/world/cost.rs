//! Costs of a silent drive, damaged frames and unanswered stops for the other drives of a line.

use std::time::Duration;

use drivegate_bus::predict::predict;
use drivegate_core::order::{Order, Urgency};
use drivegate_core::plant::Placed;
use drivegate_core::process_image::DriveSpec;
use drivegate_model::drive::{ModelPoint, PollClass, Value};
use drivegate_proto::wire::Silence;
use drivegate_proto::{Protocol, RequestPdu};

use super::bus::{Parts, Seen};
use super::rig::{Rig, line};
use super::scenario::Line;

const MINUTE: Duration = Duration::from_secs(60);

fn rig(line: &Line) -> Rig {
    Rig::new(line, Parts::of(0, line, 5))
}

/// Number of successful exchanges in the ten minutes after the first one.
fn exchanges(line: &Line) -> f64 {
    let mut rig = rig(line);
    rig.run(MINUTE);
    let before = rig.counts();
    rig.run(10 * MINUTE);
    let counts = rig.counts().since(before);
    counts.ok as f64
}

fn cost(sound: &Line, change: impl Fn(&mut Line)) -> f64 {
    let mut troubled = sound.clone();
    change(&mut troubled);
    1.0 - exchanges(&troubled) / exchanges(sound)
}

const N2: [&str; 2] = ["vacon-nx-n2", "teco-7300pa-n2"];

#[test]
fn one_dead_drive_costs_its_line_two_percent_at_most() {
    let mut lines: Vec<Line> = N2.map(|family| line(family, Protocol::N2, 9600, 3)).into();
    lines.push(line("vacon-nx", Protocol::ModbusRtu, 9600, 10));
    lines.push(line("vacon-nx", Protocol::ModbusRtu, 115_200, 10));
    for line in lines {
        let cost = cost(&line, |line| line.dead = vec![line.drives]);
        assert!(cost <= 0.02, "{} at {}: {cost:.4}", line.family, line.baud);
    }
}

#[test]
fn garbled_frames_cost_an_n2_line_ten_percent_at_most() {
    for family in N2 {
        let line = line(family, Protocol::N2, 9600, 3);
        let cost = cost(&line, |line| line.faults = "corrupt=0.02".to_string());
        assert!(cost <= 0.1, "{family}: {cost:.4}");
    }
}

#[test]
fn the_first_probe_of_a_silent_drive_comes_within_ten_seconds() {
    let patient = Duration::from_millis(3_500);
    for (family, protocol) in [("vacon-nx", Protocol::ModbusRtu), ("vacon-nx-n2", Protocol::N2)] {
        for timeout in [protocol.usual_timeout(), patient] {
            let line = Line {
                response_timeout: timeout,
                ..line(family, protocol, 9600, 3)
            };
            let mut rig = rig(&line);
            rig.run(MINUTE);
            for _ in 0..5 {
                rig.bus.wire.slaves().drive(2).unwrap().set_alive(false);
                rig.until("it counts as offline", MINUTE, |rig| !rig.is_online(1));
                let asks = |rig: &Rig| {
                    rig.bus
                        .core
                        .asked()
                        .is_some_and(|turn| turn.drive().is_some_and(|drive| drive == 1))
                };
                let pause = rig.until("it is probed", MINUTE, asks);
                let bounds = Duration::from_millis(500)..=Duration::from_secs(10);
                assert!(bounds.contains(&pause), "{family}, {timeout:?}: {pause:?}");
                rig.bus.wire.slaves().drive(2).unwrap().set_alive(true);
                rig.until("it is back", MINUTE, |rig| rig.is_online(1));
                rig.run(MINUTE / 2);
            }
        }
    }
}

/// The oldest process data of any drive except the last within `time`, while stops are given to the last one, and
/// the number of stops sent.
fn oldest(rig: &mut Rig, time: Duration, stops: Option<Duration>) -> (Duration, u32) {
    let silent = rig.bus.line.drives;
    let end = rig.now + time;
    let mut next = rig.now;
    let (mut oldest, mut sent) = (Duration::ZERO, 0);
    loop {
        if let Some(every) = stops.filter(|_| rig.now >= next) {
            let run = rig.bus.profile.model_index(ModelPoint::Run).unwrap();
            rig.place(silent, Order::Points(vec![(run, Value::Bool(false))]));
            next += every;
        }
        let until = if stops.is_some() { next.min(end) } else { end };
        let Some(seen) = rig.step(until) else {
            if rig.now >= end {
                return (oldest, sent);
            }
            continue;
        };
        let rank = rig.bus.core.asked().and_then(|turn| turn.rank());
        for one in seen {
            match one {
                Seen::Sent(asked) if asked.drive + 1 == usize::from(silent) => {
                    sent += u32::from(rank == Some(Urgency::Stop));
                }
                Seen::Over(asked) if asked.is_poll && asked.drive + 1 != usize::from(silent) => {
                    let image = &rig.bus.handle.image.drives[asked.drive];
                    let mut fast = image.plan.reads.iter().filter(|read| read.class == PollClass::Fast);
                    if let Some(at) = asked.last_read.filter(|_| fast.any(|read| read.pdu() == asked.pdu)) {
                        oldest = oldest.max(rig.now - at);
                    }
                }
                _ => {}
            }
        }
    }
}

#[test]
fn stops_to_a_silent_drive_leave_the_others_their_data() {
    let line = line("vacon-nx", Protocol::ModbusRtu, 9600, 30);
    let mut rig = rig(&line);
    rig.run(2 * MINUTE);
    let image = &rig.bus.handle.image;
    let specs: Vec<DriveSpec> = image.drives.iter().map(|drive| drive.spec.clone()).collect();
    let round = predict(&image.spec, Silence::Spec, &specs).fast_cycle.unwrap();
    // The first stops may use half of the line, those of a flood a tenth.
    let most = round * 5 / 2 + 2 * line.response_timeout;
    rig.bus.wire.slaves().drive(30).unwrap().set_alive(false);
    let (first, sent) = oldest(&mut rig, MINUTE, Some(Duration::from_millis(50)));
    let (seldom, sent2) = oldest(&mut rig, 2 * MINUTE, Some(Duration::from_millis(700)));
    assert!(sent > 10 && sent2 > 10, "{sent} and {sent2} stops went out");
    assert!(first.max(seldom) <= most, "{first:?} and {seldom:?}, bound {most:?}");
}

/// A thousand references a second to one drive, and twenty of another client to another.
#[test]
fn a_flood_leaves_half_of_the_line_to_polls_and_its_turn_to_another_client() {
    let ms = Duration::from_millis;
    let mut rig = rig(&line("vacon-nx", Protocol::ModbusRtu, 38_400, 2));
    rig.run(MINUTE / 4);
    let (mut others, mut sent_to_other) = (Vec::new(), 0);
    let (mut polls, mut commands) = (Duration::ZERO, Duration::ZERO);
    for number in 0..4_000 {
        // By then the flood is in progress.
        if number == 1_000 {
            for percent in 1..=20 {
                let order = Order::Write(RequestPdu::WriteRegister {
                    address: 2002,
                    value: percent * 100,
                });
                others.push(rig.place_as("other", 2, order));
            }
        }
        let order = rig.points(1, &[("speed_reference", f64::from(number % 80))]);
        rig.place_as("flood", 1, order);
        let until = rig.now + ms(1);
        while let Some(seen) = rig.step(until) {
            for one in seen {
                match one {
                    Seen::Sent(asked) if !asked.is_poll && asked.drive == 1 => {
                        sent_to_other += 1;
                        let value = sent_to_other * 100;
                        assert_eq!(
                            asked.pdu,
                            RequestPdu::WriteRegister { address: 2002, value },
                            "in order"
                        );
                    }
                    Seen::Over(asked) if asked.is_poll => polls += rig.now - asked.at,
                    Seen::Over(asked) => commands += rig.now - asked.at,
                    _ => {}
                }
            }
        }
    }
    assert_eq!(sent_to_other, 20);
    for order in &mut others {
        assert!(rig.answered(order).is_ok());
    }
    assert!(commands > ms(1_000), "a flood: {commands:?}");
    assert!(
        polls.as_secs_f64() > 0.9 * commands.as_secs_f64(),
        "{polls:?} of polls, {commands:?} of commands"
    );
}

/// Two clients that continuously stop a standing drive, as a PLC does that writes 0 in a loop, and a third client.
#[test]
fn stops_in_a_loop_keep_no_other_client_waiting() {
    let ms = Duration::from_millis;
    let mut rig = rig(&line("vacon-nx", Protocol::ModbusRtu, 9600, 6));
    rig.run(MINUTE / 4);
    let end = rig.now + MINUTE;
    let mut stops: [Option<Placed>; 2] = [None, None];
    let (mut reference, mut next, mut begun) = (None::<Placed>, rig.now, rig.now);
    let (mut stopped, mut longest) = (0, Duration::ZERO);
    while rig.now < end {
        for (index, place) in stops.iter_mut().enumerate() {
            if place.as_mut().is_none_or(|placed| placed.answer().is_some()) {
                let address = index as u8 + 1;
                let order = rig.points(address, &[("run", 0.0)]);
                *place = Some(rig.place_as(&format!("plc {index}"), address, order));
                stopped += 1;
            }
        }
        if let Some(placed) = &mut reference
            && let Some(answer) = placed.answer()
        {
            assert!(answer.outcome.is_ok(), "{:?}", answer.outcome);
            longest = longest.max(rig.now - begun);
            reference = None;
        }
        if reference.is_none() && rig.now >= next {
            let order = rig.points(3, &[("speed_reference", f64::from(stopped % 80))]);
            reference = Some(rig.place_as("operator", 3, order));
            (begun, next) = (rig.now, rig.now + ms(500));
        }
        let until = rig.now + ms(1);
        while rig.step(until).is_some() {}
    }
    assert!(stopped > 500, "{stopped} stops");
    assert!(longest < ms(1_000), "an order waited {longest:?}");
}
