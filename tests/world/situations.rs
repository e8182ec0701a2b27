//! Situations that random worlds meet too seldom; each test sets one up on one bus.

use std::time::{Duration, Instant};

use drivegate_core::order::{Order, Outcome};
use drivegate_core::plant::Placed;
use drivegate_core::process_image::{LeaseAction, OnShutdown, Supervision};
use drivegate_model::drive::{ModelPoint, Value};
use drivegate_proto::{Protocol, Reply, Table};
use drivegate_sim::faults::FaultPlan;
use drivegate_sim::random::Random;

use super::bus::{Parts, Seen};
use super::clients::{Servers, answers, write_frame};
use super::orders::run_command;
use super::rig::{Rig, line};
use super::scenario::{Habit, Line};

const SECOND: Duration = Duration::from_secs(1);

fn rig(line: &Line) -> Rig {
    let mut rig = Rig::new(line, Parts::of(0, line, 5));
    rig.until("all drives are read", 15 * SECOND, Rig::is_whole);
    rig.run(3 * SECOND);
    rig
}

fn run(rig: &Rig, on: bool) -> Order {
    Order::Points(vec![(
        rig.bus.profile.model_index(ModelPoint::Run).unwrap(),
        Value::Bool(on),
    )])
}

fn faults(rates: &str, seed: u64) -> FaultPlan {
    FaultPlan::new(rates.parse().unwrap(), seed)
}

/// The answer to an order, which must arrive within `most`.
fn answer(rig: &mut Rig, mut placed: Placed, most: Duration) -> Outcome {
    let until = rig.now + most;
    loop {
        if let Some(answer) = placed.answer() {
            return answer.outcome;
        }
        assert!(rig.step(until).is_some(), "no answer within {most:?}");
    }
}

fn supervised(family: &'static str, protocol: Protocol, baud: u32) -> Line {
    let supervision = Supervision {
        timeout: SECOND,
        action: LeaseAction::Stop,
        adopt: false,
    };
    Line {
        supervision: Some(supervision),
        ..line(family, protocol, baud, 2)
    }
}

/// Runs the first drive for a client that is then silent forever.
fn leave_running(rig: &mut Rig) {
    let placed = rig.place(1, run(rig, true));
    let outcome = answer(rig, placed, 3 * SECOND);
    assert!(outcome.is_ok(), "{outcome:?}");
    rig.run(SECOND / 2);
    assert!(is_running(rig));
}

fn is_running(rig: &mut Rig) -> bool {
    let sim = rig.bus.sim(rig.now);
    let drive = rig.bus.wire.slaves().drive(1).unwrap();
    drive.advance(sim);
    drive.state().running
}

#[test]
fn an_action_that_the_drive_does_not_hear_is_written_again() {
    for seed in 0..16 {
        let mut rig = rig(&supervised("vacon-nx", Protocol::ModbusRtu, 19_200));
        leave_running(&mut rig);
        // Half of the requests are lost: of one action in four both tries.
        rig.set_faults(faults("deaf=0.5", seed));
        // Most of the time the drive is offline, and probed every 10 s.
        rig.run(120 * SECOND);
        assert!(
            !is_running(&mut rig),
            "seed {seed}: it runs 120 s after its client fell silent"
        );
    }
}

/// A drive that is offline when the gateway begins to end, and returns within its time, is stopped.
#[test]
fn a_stop_of_the_shutdown_is_ordered_again() {
    for (family, protocol) in [("vacon-nx", Protocol::ModbusRtu), ("vacon-nx-n2", Protocol::N2)] {
        let timeout = if protocol == Protocol::N2 { 250 } else { 60 };
        let works = Line {
            on_shutdown: OnShutdown::Stop,
            response_timeout: Duration::from_millis(timeout),
            ..line(family, protocol, 9_600, 1)
        };
        let mut rig = rig(&works);
        leave_running(&mut rig);
        assert!(is_running(&mut rig));
        rig.set_alive(1, false);
        let deadline = rig.now + 4 * SECOND;
        let mut report = rig.bus.handle.queue.begin_shutdown(deadline, rig.now);
        rig.bus.command_came(rig.now);
        rig.run(Duration::from_millis(1_500));
        rig.set_alive(1, true);
        while report
            .try_recv()
            .map(|missing| assert!(missing.is_empty(), "{missing:?}"))
            .is_err()
        {
            assert!(rig.step(deadline).is_some(), "{family}: no report");
        }
        rig.run(5 * SECOND);
        assert!(!is_running(&mut rig), "{family}");
    }
}

#[test]
fn a_lease_goes_on_across_a_reload() {
    for (family, protocol, baud) in [
        ("vacon-nx", Protocol::ModbusRtu, 19_200),
        ("teco-7300pa", Protocol::ModbusAscii, 19_200),
        ("vacon-nx-n2", Protocol::N2, 9600),
    ] {
        let mut rig = rig(&supervised(family, protocol, baud));
        leave_running(&mut rig);
        rig.restart();
        rig.run(12 * SECOND);
        assert!(!is_running(&mut rig), "{family}: it runs, and its lease is lost");
    }
}

/// Two clients: one fills the queue for two drives, the other gives a single order to the third.
#[test]
fn who_has_much_waiting_does_not_keep_another_waiting() {
    for (family, protocol) in [("vacon-nx", Protocol::ModbusRtu), ("vacon-nx-n2", Protocol::N2)] {
        let mut rig = rig(&line(family, protocol, 9600, 3));
        for order in 0..60 {
            let on = run(&rig, true);
            rig.place_as("many", 1 + order % 2, on);
        }
        let on = run(&rig, true);
        let placed = rig.place_as("one", 3, on);
        let outcome = answer(&mut rig, placed, 3 * SECOND);
        assert!(outcome.is_ok(), "{family}: {outcome:?}");
    }
}

/// Over Modbus TCP, the many orders come over as many connections of one client.
#[test]
fn connections_of_one_client_share_its_turns() {
    let mut rig = rig(&line("vacon-nx-n2", Protocol::N2, 9600, 3));
    let servers = Servers::new(rig.shared_plant());
    let mut kept = Vec::new();
    for connection in (0..96).step_by(2).chain((1..96).step_by(2)) {
        // Connections with even numbers are one client by its certificate, the others one by its address.
        let mut client = servers.connection(Habit::Shares, connection);
        let unit = 1 + (connection / 2 % 2) as u8;
        client.receive(&write_frame(1, unit, 0x8100, 1), rig.now);
        kept.push(client);
    }
    let mut other = servers.connection(Habit::ModbusTcp, 1);
    let mut bytes = other.receive(&write_frame(7, 3, 0x8100, 1), rig.now);
    rig.bus.command_came(rig.now);
    let until = rig.now + 3 * SECOND;
    while bytes.is_empty() {
        assert!(rig.step(until).is_some(), "no answer within 3 s");
        bytes = other.receive(&[], rig.now);
    }
    assert_eq!(answers(&bytes), [(7, None)], "the order of the other client");
}

#[test]
fn a_reference_in_hertz_rests_on_no_old_maximum_frequency() {
    let line = Line {
        slow_cycle: 4 * SECOND,
        ..line("vacon-nx", Protocol::ModbusRtu, 19_200, 2)
    };
    let mut rig = rig(&line);
    let at = |rig: &Rig| rig.bus.handle.image.drives[0].snapshot().read_at(Table::Holding, 101);
    let before = at(&rig);
    rig.until("the maximum frequency is read", 10 * SECOND, |rig| at(rig) != before);
    let (read, now) = (at(&rig), rig.now);
    // The limit is raised at the panel; its next read comes when the drive is busy.
    assert_eq!(rig.bus.maximum_frequency(1, Some(100.0), now), Some(100.0));
    rig.run(Duration::from_millis(3_700));
    rig.set_faults(faults("busy=1", 1));
    rig.run(Duration::from_millis(1_900));
    rig.set_faults(FaultPlan::default());
    assert_eq!(at(&rig), read, "it was not read again for {:?}", rig.now - now);
    let index = rig.bus.profile.model_index(ModelPoint::FrequencyReference).unwrap();
    let placed = rig.place(1, Order::Points(vec![(index, Value::Number(25.0))]));
    let outcome = answer(&mut rig, placed, 3 * SECOND);
    let has = rig
        .bus
        .wire
        .slaves()
        .drive(1)
        .unwrap()
        .as_nx()
        .unwrap()
        .state()
        .reference;
    assert!(
        !outcome.is_ok() || has == 2500,
        "25 of 100 Hz are written as {has}: {outcome:?}"
    );
}

/// A client that commands the first drive to run and to stop in turn, on a line with faults.
struct Duel {
    rig: Rig,
    /// Orders without an answer: to run or to stop, and when they were accepted.
    open: Vec<(bool, Instant, Placed)>,
    /// Commands that the drive got and accepted.
    reported: Vec<(Instant, bool)>,
}

impl Duel {
    fn fight(line: &Line, rates: &str, seed: u64, time: Duration) -> u32 {
        let mut duel = Duel {
            rig: rig(line),
            open: Vec::new(),
            reported: Vec::new(),
        };
        duel.rig.set_faults(faults(rates, seed));
        let (end, mut dice, mut on, mut stops) = (duel.rig.now + time, Random::new(seed), false, 0);
        while let Some(seen) = duel.rig.step(end) {
            stops += duel.collect();
            seen.iter().for_each(|one| duel.look(one));
            if duel.open.is_empty() || (duel.open.len() == 1 && dice.chance(0.02)) {
                on = !on;
                let order = run(&duel.rig, on);
                let placed = duel.rig.place(1, order);
                duel.open.push((on, duel.rig.now, placed));
            }
        }
        stops
    }

    /// An acknowledged stop has reached the drive.
    fn collect(&mut self) -> u32 {
        let (reported, mut stops) = (&self.reported, 0);
        self.open.retain_mut(|(on, accepted, placed)| {
            let Some(answer) = placed.answer() else { return true };
            if !*on && answer.outcome.is_ok() {
                let since = |(at, on): &(Instant, bool)| at >= accepted && !on;
                let stands = reported.last().is_none_or(|(_, on)| !on);
                assert!(
                    stands || reported.iter().any(since),
                    "a stop is acknowledged that the drive did not hear"
                );
                stops += 1;
            }
            false
        });
        stops
    }

    /// Checks that no run command is sent while an older stop is still unanswered.
    fn look(&mut self, seen: &Seen) {
        match seen {
            Seen::Acted(asked) if !matches!(asked.reply, Some(Reply::Exception(_))) && asked.drive == 0 => {
                let now = self.rig.now;
                self.reported
                    .extend(run_command(&self.rig.bus.profile, &asked.pdu).map(|on| (now, on)));
            }
            Seen::Sent(asked) if asked.drive == 0 && run_command(&self.rig.bus.profile, &asked.pdu) == Some(true) => {
                let stop = self.open.iter().position(|(on, ..)| !on);
                let run = self.open.iter().rposition(|(on, ..)| *on);
                assert!(stop.is_none() || run < stop, "a run goes out before an older stop");
            }
            _ => {}
        }
    }
}

#[test]
fn stops_and_runs_among_late_and_lost_replies() {
    let modbus = line("vacon-nx", Protocol::ModbusRtu, 115_200, 1);
    let n2 = line("vacon-nx-n2", Protocol::N2, 9600, 1);
    for seed in 0..4 {
        let stops = Duel::fight(&modbus, "late:150ms=0.2,late:180ms=0.2,deaf=0.3", seed, 240 * SECOND);
        assert!(stops > 20, "{stops} stops were acknowledged");
        let stops = Duel::fight(&n2, "late:300ms=0.15,late:450ms=0.1,deaf=0.2", seed, 240 * SECOND);
        assert!(stops > 20, "{stops} stops were acknowledged");
    }
}
