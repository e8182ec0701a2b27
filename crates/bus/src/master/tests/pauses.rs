//! The thread of the bus is stalled and then continues.

use super::*;
use drivegate_core::order::{Arrival, Connection, Interruption, Window};

const MS: Duration = Duration::from_millis(1);
const FIRST: DriveIndex = DriveIndex::new(0);

impl Rig {
    fn stands(&mut self, time: Duration) -> Stall {
        let began = self.now;
        self.now += time;
        let stall = Stall::new(began, self.now);
        self.master.after_stall(stall, self.now);
        stall
    }

    /// The next transaction for which `is_it` holds; earlier ones are ended.
    fn next_turn(&mut self, is_it: impl Fn(&Turn) -> bool) -> Turn {
        loop {
            match self.master.next(self.now, &mut Vec::new()) {
                Err(until) => self.now = until,
                Ok(turn) if is_it(&turn) => {
                    self.master.sending(&turn, self.now);
                    return turn;
                }
                Ok(turn) => {
                    self.master.sending(&turn, self.now);
                    let ended = self.drives[drive_of(&turn)].answer(turn.pdu());
                    self.ends(&turn, ended, (self.now + COST, false));
                }
            }
        }
    }

    /// Ends the turn at this time, with or without a stall of the thread; returns the news.
    fn ends(&mut self, turn: &Turn, ended: Ended, (at, stood): (Instant, bool)) -> Vec<News> {
        let (began, mut news) = (self.now, Vec::new());
        self.now = self.now.max(at);
        let end = TurnEnd {
            ended,
            began,
            at,
            stood,
            took: at.saturating_duration_since(began),
            mangled: false,
            doubted: false,
            frame: Vec::new(),
        };
        self.master.done(turn, end, self.now, &mut news);
        news.iter().for_each(|news| self.apply(news));
        news
    }
}

fn is_poll(turn: &Turn) -> bool {
    matches!(turn.purpose, Purpose::Poll(_))
}

#[test]
fn a_sample_is_dated_from_when_its_reply_came_however_late_it_is_read() {
    let mut rig = Rig::new(1);
    let turn = rig.next_turn(is_poll);
    let came = rig.now + COST;
    let reply = rig.drives[0].answer(turn.pdu());
    rig.now += 5000 * MS;
    let news = rig.ends(&turn, reply, (came, true));
    let dates: Vec<Instant> = news
        .iter()
        .filter_map(|news| match news {
            News::Read { at, .. } => Some(*at),
            _ => None,
        })
        .collect();
    assert_eq!(dates, [came]);
}

#[test]
fn a_drive_is_not_away_because_the_gateway_stood_still() {
    for (stood, is_away) in [(true, false), (false, true)] {
        let mut rig = Rig::new(1);
        let mut news = Vec::new();
        for _ in 0..3 {
            let turn = rig.next_turn(is_poll);
            let at = rig.now + TIMEOUT;
            news.append(&mut rig.ends(&turn, Ended::Silent, (at, stood)));
        }
        assert_eq!(news.contains(&News::Offline(FIRST)), is_away, "{stood}");
    }
}

#[test]
fn a_lease_lasts_longer_by_what_nobody_was_heard_but_not_twice_as_long() {
    // A lease of 500 ms: stalls of the thread, each 100 ms after the last, and how long the motor runs then.
    for (stalls, least, most) in [
        (&[][..], 450, 600),
        (&[300], 750, 900),
        (&[300, 300], 950, 1100),
        (&[450, 450], 1050, 1250),
        (&[2000], 2050, 2200),
    ] {
        let mut rig = Rig::new(1);
        let _run = rig.switch(0, "client", true);
        while !rig.runs(0) {
            rig.step();
        }
        rig.run(MS);
        let started = rig.now;
        for stall in stalls {
            rig.run(100 * MS);
            rig.stands(MS * *stall);
        }
        while rig.runs(0) {
            rig.step();
            assert!(rig.now < started + 4000 * MS);
        }
        let ran = (rig.now - started).as_millis();
        assert!((least..=most).contains(&ran), "{stalls:?}: {ran}");
    }
}

/// A reference and another point, which starts the motor or only sets a value: the first of the two is on the wire.
#[test]
fn a_sequence_that_a_pause_interrupted_is_not_continued() {
    let run = ("run", Value::Bool(true), 2000);
    let data = ("process_data_in_5", Value::Number(30.0), 2007);
    for (time, (last, value, register), goes_on) in [
        (400, run, true),
        (1100, run, false),
        (400, data, true),
        (1100, data, false),
    ] {
        let mut rig = Rig::new(1);
        let image = &rig.bus.image.drives[0];
        let points = [("speed_reference", Value::Number(50.0)), (last, value)];
        let points = points.map(|(point, value)| (image.spec.profile.point_index(point).unwrap(), value));
        let order = Order::Points(points.to_vec());
        let origin = Origin::new(SourceKind::Mqtt, "client");
        let window = Window {
            arrival: Arrival::now(rig.now),
            expires: rig.now + 10_000 * MS,
            waits: false,
        };
        let mut answer = submit(&rig.bus, FIRST, origin, order, window, rig.now);
        let turn = rig.next_turn(|turn| turn.pdu().is_write());
        let began = rig.now;
        rig.stands(MS * time);
        let reply = rig.drives[0].answer(turn.pdu());
        rig.ends(&turn, reply, (began + COST, true));
        rig.run(300 * MS);
        let word = |register: u16| rig.drives[0].holding.get(&register).copied().unwrap_or(0);
        assert_eq!((word(2002), word(register) != 0), (5000, goes_on), "{last}, {time} ms");
        let expected = (!goes_on).then_some(Outcome::Interrupted(Interruption::Expired));
        assert_eq!(
            outcome(&mut answer).filter(|o| !o.is_ok()),
            expected,
            "{last}, {time} ms"
        );
    }
}

/// A direction is ordered to a motor that runs. The drive restarts behind the read that shows that, and the thread of the bus
/// stalls before it has the reply, or behind it.
#[test]
fn what_was_read_before_a_stall_lets_no_run_bit_through() {
    for (stalled, runs) in [
        ("never", true),
        ("before the reply", false),
        ("behind the reply", false),
    ] {
        let mut rig = Rig::new(1);
        let _run = rig.switch(0, "client", true);
        rig.run(200 * MS);
        assert!(rig.runs(0));
        let _reverse = rig.order(0, "client", ModelPoint::Reverse, Value::Bool(true));
        let turn = rig.next_turn(|turn| {
            matches!(
                turn.pdu(),
                RequestPdu::Read {
                    start: 2100,
                    count: 2,
                    ..
                }
            )
        });
        let reply = rig.drives[0].answer(turn.pdu());
        rig.drives[0].holding.insert(2000, 0);
        let came = rig.now + COST;
        if stalled == "before the reply" {
            rig.stands(270 * MS);
        }
        rig.ends(&turn, reply, (came, stalled == "before the reply"));
        if stalled == "behind the reply" {
            rig.stands(270 * MS);
        }
        rig.run(100 * MS);
        assert_eq!(rig.runs(0), runs, "stalled {stalled}");
    }
}

#[test]
fn the_end_of_a_reset_is_sent_after_a_pause() {
    let mut rig = Rig::new(1);
    rig.drives[0].holding.insert(2100, 8);
    rig.run(500 * MS);
    let _answer = rig.order(0, "client", ModelPoint::FaultReset, Value::Bool(true));
    let turn = rig.next_turn(|turn| turn.pdu().is_write());
    let set = turn.pdu().clone();
    let began = rig.now;
    let reply = rig.drives[0].answer(turn.pdu());
    rig.ends(&turn, reply, (began + COST, false));
    rig.stands(3000 * MS);
    let turn = rig.next_turn(|turn| turn.pdu().is_write());
    let word = |pdu: &RequestPdu| match pdu {
        RequestPdu::WriteRegister { address: 2000, value } => *value,
        other => panic!("{other:?}"),
    };
    assert_eq!((word(&set) & 4, word(turn.pdu()) & 4), (4, 0));
}

#[test]
fn a_start_that_came_in_a_stall_goes_when_what_came_with_it_is_read() {
    let mut rig = Rig::new(1);
    let began = rig.now;
    rig.now += 200 * MS;
    let stall = Stall::new(began, rig.now);
    let image = &rig.bus.image.drives[0];
    let index = image.spec.profile.model_index(ModelPoint::Run).unwrap();
    let order = Order::Points(vec![(index, Value::Bool(true))]);
    let origin = Origin::new(SourceKind::Mqtt, "client");
    let window = Window {
        arrival: Arrival {
            stall: Some(stall),
            ..Arrival::over(Connection::opened(began), began)
        },
        expires: began + DEFAULT_EXPIRY,
        waits: false,
    };
    let _answer = submit(&rig.bus, FIRST, origin, order, window, rig.now);
    while !rig.runs(0) {
        rig.step();
        assert!(rig.now < stall.read_by() + 100 * MS);
    }
    assert!(rig.now >= stall.read_by(), "a stop may be read until then");
}
