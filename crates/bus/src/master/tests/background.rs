//! Background transactions: their share of the line, and what they must never do.

use super::*;
use drivegate_core::order::{BackgroundRequest, Pace};
use drivegate_model::drive::DriveIndex;

/// Address of a register that no poll reads.
const REGISTER: u16 = 700;

impl Rig {
    fn ask(&self, drive: usize, who: &str, pace: Pace) -> Receiver<Answer> {
        self.ask_for(drive, who, pace, 1)
    }

    fn ask_for(&self, drive: usize, who: &str, pace: Pace, count: u16) -> Receiver<Answer> {
        let origin = Origin::new(SourceKind::LocalSocket, who);
        let (ticket, answer) = Ticket::new(
            origin,
            "d",
            String::new(),
            false,
            self.now,
            self.bus.command_log.clone(),
        );
        let request = BackgroundRequest {
            target: DriveIndex::new(drive).into(),
            pdu: RequestPdu::read(Table::Holding, REGISTER, count),
            pace,
            expires: self.now + Duration::from_secs(60),
            ticket,
            passed_on: None,
        };
        self.bus.queue.submit_background(request, self.now);
        answer
    }

    /// Runs while each client sends its next request as soon as it has an answer.
    fn run_asking(&mut self, time: Duration, clients: &[(&str, Pace)]) {
        let end = self.now + time;
        let mut waiting: Vec<Option<Receiver<Answer>>> = clients.iter().map(|_| None).collect();
        while self.now < end {
            for (answer, (who, pace)) in waiting.iter_mut().zip(clients) {
                if answer.as_mut().is_none_or(|answer| outcome(answer).is_some()) {
                    *answer = Some(self.ask(0, who, *pace));
                }
            }
            self.step();
        }
    }

    /// Rounds of a minute that began late.
    fn late_rounds(&mut self, cycle: Duration, clients: &[(&str, Pace)]) -> usize {
        let from = self.wire.len();
        self.run_asking(Duration::from_secs(60), clients);
        let rounds = self.wire[from..].iter().filter(|(_, turn)| is_fast(turn));
        let rounds: Vec<Instant> = rounds.map(|(at, _)| *at).collect();
        let late = |pair: &&[Instant]| pair[1] - pair[0] > cycle + Duration::from_millis(1);
        rounds.windows(2).filter(late).count()
    }

    fn count(&self, from: usize, which: impl Fn(&Turn) -> bool) -> usize {
        self.wire[from..].iter().filter(|(_, turn)| which(turn)).count()
    }
}

fn is_background(turn: &Turn) -> bool {
    matches!(turn.purpose, Purpose::Background(_))
}

fn is_fast(turn: &Turn) -> bool {
    matches!(&turn.purpose, Purpose::Poll(poll) if poll.read.class == PollClass::Fast)
}

#[test]
fn a_busy_line_loses_no_more_process_data_than_the_share_says() {
    let minutes = Duration::from_secs(120);
    let polls = |clients: &[(&str, Pace)]| {
        let mut rig = Rig::new(3);
        let from = rig.wire.len();
        rig.run_asking(minutes, clients);
        (
            rig.count(from, is_fast),
            rig.count(from, is_background),
            rig.wire.len() - from,
        )
    };
    let (alone, none, _) = polls(&[]);
    assert_eq!(none, 0);
    let (slow, read, all) = polls(&[("params", Pace::Slow)]);
    assert!(slow as f64 >= 0.98 * alone as f64, "{slow} of {alone}");
    assert!(read as f64 >= 0.013 * all as f64, "{read} of {all}: it gets its share");
    let (both, asked, all) = polls(&[
        ("params", Pace::Slow),
        ("tool", Pace::Brisk),
        ("second tool", Pace::Brisk),
    ]);
    assert!(both as f64 >= 0.8 * alone as f64, "{both} of {alone}");
    assert!(
        asked as f64 >= 0.15 * all as f64 && asked as f64 <= 0.2 * all as f64,
        "{asked} of {all}"
    );
}

#[test]
fn time_that_is_left_over_is_used_and_no_round_is_late_by_that() {
    let cycle = Duration::from_millis(100);
    let mut rig = Rig::at(1, "vacon-nx", Protocol::ModbusRtu, cycle);
    // The first transactions show that this drive is slower than its profile states.
    rig.run_asking(Duration::from_secs(10), &[("params", Pace::Slow)]);
    let from = rig.wire.len();
    let late = rig.late_rounds(cycle, &[]);
    let late_asking = rig.late_rounds(cycle, &[("params", Pace::Slow)]);
    assert!(
        late_asking <= late,
        "{late_asking} rounds late, {late} by slow polls alone"
    );
    let read = rig.count(from, is_background);
    assert!(
        read >= 1500,
        "{read}: 80 of 100 ms are left over, with slow polls in them"
    );
}

#[test]
fn a_drive_that_is_silent_to_a_request_delays_no_more_than_the_share() {
    let cycle = Duration::from_millis(100);
    let mut rig = Rig::at(1, "vacon-nx", Protocol::ModbusRtu, cycle);
    let (from, begin) = (rig.wire.len(), rig.now);
    let mut answer = rig.ask(0, "params", Pace::Slow);
    let mut silent = 0;
    while rig.now < begin + Duration::from_secs(60) {
        if let Some(outcome) = outcome(&mut answer) {
            assert_eq!(outcome, Outcome::TimedOut);
            silent += 1;
            answer = rig.ask(0, "params", Pace::Slow);
        }
        // Only background requests notice that the drive is silent.
        let mut news = Vec::new();
        rig.drives[0].silent = match rig.master.next(rig.now, &mut news) {
            Ok(turn) => is_background(&turn),
            Err(_) => false,
        };
        news.iter().for_each(|one| rig.apply(one));
        rig.step();
    }
    assert!(silent >= 5, "{silent}");
    assert!(
        !rig.news.contains(&News::Offline(DriveIndex::new(0))),
        "its process data comes"
    );
    assert!(rig.count(from, is_fast) >= 588, "98 % of 600 rounds");
}

#[test]
fn a_stop_waits_for_the_exchange_on_the_line_only() {
    let longest = |tools: usize| {
        let mut rig = Rig::new(1);
        let mut longest = Duration::ZERO;
        for round in 0..200 {
            let tools: Vec<_> = (0..tools)
                .map(|k| rig.ask(0, &format!("tool {k}"), Pace::Brisk))
                .collect();
            let mut run = rig.switch(0, "a", true);
            while outcome(&mut run).is_none() {
                rig.step();
            }
            for _ in 0..round % 7 {
                rig.step();
            }
            let mut stop = rig.switch(0, "a", false);
            let begin = rig.now;
            while outcome(&mut stop).is_none() {
                rig.step();
            }
            longest = longest.max(rig.now - begin);
            drop(tools);
        }
        longest
    };
    // The rig is between two transactions when the stop arrives, so waiting requests do not delay the stop.
    assert_eq!(longest(6), longest(0));
}

#[test]
fn every_request_is_answered_once_whatever_happens() {
    let mut seed: u64 = 11;
    let mut below = |bound: u64| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (seed >> 33) % bound
    };
    for _ in 0..40 {
        let mut rig = Rig::new(2);
        let mut answers = Vec::new();
        for _ in 0..200 {
            match below(8) {
                0 => rig.drives[0].silent = !rig.drives[0].silent,
                1 => {
                    let now = rig.now;
                    rig.bus.queue.close(Outcome::BusDown, now);
                    rig.master.lost(now);
                    rig.master.opened(now);
                    rig.bus.queue.open();
                }
                2..=4 => {
                    let pace = if below(2) == 0 { Pace::Slow } else { Pace::Brisk };
                    let who = format!("client {}", below(5));
                    answers.push(rig.ask(below(2) as usize, &who, pace));
                }
                5 => drop(rig.switch(below(2) as usize, "a", below(2) == 0)),
                _ => rig.run(Duration::from_millis(below(400))),
            }
        }
        rig.run(Duration::from_secs(70));
        let now = rig.now;
        let missing = answers
            .iter_mut()
            .filter_map(|answer| outcome(answer).is_none().then_some(()));
        assert_eq!(missing.count(), 0);
        // A request that waits when the gateway ends is answered, too.
        let mut last = rig.ask(1, "late", Pace::Slow);
        let _missing = rig.bus.queue.begin_shutdown(now + Duration::from_secs(1), now);
        assert_eq!(outcome(&mut last), Some(Outcome::ShuttingDown));
    }
}

#[test]
fn nobody_has_more_than_its_places() {
    let rig = Rig::new(1);
    let mut answers: Vec<_> = (0..9).map(|_| rig.ask(0, "one", Pace::Slow)).collect();
    assert_eq!(outcome(answers.last_mut().unwrap()), Some(Outcome::QueueFull));
    assert_eq!(outcome(&mut answers[0]), None);
    let mut other = rig.ask(0, "other", Pace::Slow);
    assert_eq!(outcome(&mut other), None);
}
