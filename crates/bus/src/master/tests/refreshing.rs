//! Refreshes of a drive of each kind of command word, in virtual time.

mod others;
mod words;

use super::family_drive::FamilyDrive;
use super::*;
use drivegate_core::order::written;
use drivegate_core::permit::DrillLock;
use drivegate_model::drive::Profile;

const EVERY: Duration = Duration::from_secs(1);

/// Whether the control word is repeated; otherwise only the reference is.
const FAMILIES: [(&str, bool); 13] = [
    ("abb-acs550", true),
    ("abb-acs580", false),
    ("siemens-g120", true),
    ("schneider-altivar", true),
    ("danfoss-fc", true),
    ("yaskawa-v1000", true),
    ("weg-cfw", true),
    ("teco-f510", true),
    ("toshiba-vf-s15", true),
    ("vacon-10", true),
    ("vacon-nx", true),
    ("invt-goodrive", false),
    ("delta-ms300", false),
];

struct Plant {
    rig: Rig,
    profile: Arc<Profile>,
    name: &'static str,
}

impl Plant {
    /// A drive whose motor is at standstill, and whose orders are repeated every second.
    fn new(name: &'static str) -> Plant {
        Plant::with(name, |spec| spec)
    }

    fn with(name: &'static str, other: impl Fn(DriveSpec) -> DriveSpec) -> Plant {
        let profile = drivegate_testkit::profile(name);
        let cycle = Duration::from_millis(100);
        let mut rig = Rig::empty(1, name, Protocol::ModbusRtu, cycle, |spec| {
            other(DriveSpec {
                refresh: Some(EVERY),
                supervision: Some(Settings {
                    timeout: Duration::from_secs(3600),
                    // A stop would end the refresh, too.
                    action: LeaseAction::LeaveRunning,
                    adopt: false,
                }),
                ..spec
            })
        });
        rig.drives[0].family = Some(FamilyDrive::new(&profile));
        rig.run(Duration::from_secs(12));
        Plant { rig, profile, name }
    }

    fn drive(&mut self) -> &mut FamilyDrive {
        self.rig.drives[0].family.as_mut().unwrap()
    }

    fn order(&mut self, sets: &[(ModelPoint, Value)]) {
        self.order_of(Origin::new(SourceKind::Mqtt, "client"), sets);
    }

    fn order_of(&mut self, origin: Origin, sets: &[(ModelPoint, Value)]) {
        let image = &self.rig.bus.image.drives[0];
        let index = |point| image.spec.profile.model_index(point).unwrap();
        let order = Order::Points(sets.iter().map(|(point, value)| (index(*point), *value)).collect());
        let now = self.rig.now;
        let mut answer = submit(
            &self.rig.bus,
            DriveIndex::new(0),
            origin,
            order,
            window(now, DEFAULT_EXPIRY),
            now,
        );
        let until = now + DEFAULT_EXPIRY;
        let outcome = loop {
            self.rig.step();
            if let Some(outcome) = outcome(&mut answer) {
                break outcome;
            }
            assert!(self.rig.now < until, "{}: no answer", self.name);
        };
        assert!(outcome.is_ok(), "{}: {outcome:?}", self.name);
    }

    fn starts(&mut self) {
        self.order(&[
            (ModelPoint::SpeedReference, Value::Number(50.0)),
            (ModelPoint::Run, Value::Bool(true)),
        ]);
        assert!(self.drive().runs, "{}", self.name);
    }

    fn stops(&mut self) {
        self.order(&[(ModelPoint::Run, Value::Bool(false))]);
        assert!(!self.drive().runs, "{}", self.name);
    }

    /// The refreshes of the next `seconds` seconds, each with its time and the turn right before it.
    fn refreshes(&mut self, seconds: u64) -> Vec<(Instant, RequestPdu, Turn)> {
        let from = self.rig.wire.len();
        self.rig.run(Duration::from_secs(seconds));
        let wire = &self.rig.wire[from..];
        let writes = wire
            .windows(2)
            .filter(|pair| matches!(pair[1].1.purpose, Purpose::Refresh(_)) && pair[1].1.pdu.is_write());
        writes
            .map(|pair| (pair[1].0, pair[1].1.pdu.clone(), pair[0].1.clone()))
            .collect()
    }

    /// The refresh has stopped for several seconds, and the image shows that.
    fn assert_ended(&mut self, why: &str) {
        self.rig.run(Duration::from_millis(300));
        let refreshes = self.refreshes(8);
        assert!(refreshes.is_empty(), "{} {why}: {refreshes:?}", self.name);
        assert!(!self.rig.bus.image.drives[0].is_refreshing(), "{} {why}", self.name);
        let told = self
            .rig
            .news
            .iter()
            .any(|news| matches!(news, News::RefreshEnded { .. }));
        assert!(told, "{} {why}: nothing is told", self.name);
    }

    fn is_reference(&self, pdu: &RequestPdu) -> bool {
        let (table, items) = written(pdu).unwrap();
        let of = |(address, _): &(u16, u16)| self.profile.is_repeated_reference(*address);
        table == Table::Holding && items.iter().all(of)
    }

    fn has_word(&self, pdu: &RequestPdu) -> Option<u16> {
        let at = self.profile.control.as_ref().unwrap().at;
        let (table, items) = written(pdu).unwrap();
        let here = items
            .iter()
            .find(|(address, _)| (table, *address) == (at.table, at.address));
        here.map(|(_, word)| *word)
    }
}

#[test]
fn what_stands_is_written_again_once_a_period_behind_a_look() {
    for (name, by_word) in FAMILIES {
        let mut plant = Plant::new(name);
        assert!(plant.refreshes(5).is_empty(), "{name}: nobody ordered anything");
        plant.starts();
        let word = plant.drive().word();
        let began = plant.rig.now;
        let refreshes = plant.refreshes(20);
        assert!(
            plant.drive().runs && plant.rig.bus.image.drives[0].is_refreshing(),
            "{name}"
        );
        let fed: Vec<Instant> = refreshes
            .iter()
            .filter(|(_, pdu, _)| !by_word || plant.has_word(pdu).is_some())
            .map(|(at, ..)| *at)
            .collect();
        let longest = [began].iter().chain(&fed).zip(&fed).map(|(a, b)| *b - *a).max();
        assert!((17..=21).contains(&fed.len()), "{name}: {} in 20 s", fed.len());
        assert!(longest < Some(Duration::from_millis(1400)), "{name}: {longest:?}");
        for (_, pdu, before) in &refreshes {
            if let Some(again) = plant.has_word(pdu) {
                assert!(by_word && again == word, "{name}: {pdu:?}, not {word:#06x}");
                assert!(
                    matches!(before.purpose, Purpose::Refresh(_)) && !before.pdu.is_write(),
                    "{name}: {before:?}"
                );
            } else {
                assert!(plant.is_reference(pdu), "{name}: {pdu:?}");
            }
        }
        let counted = plant.rig.bus.image.drives[0].refresh_writes();
        assert_eq!(counted, refreshes.len() as u64, "{name}");
        // After a stop, the word of the stop is refreshed.
        plant.stops();
        let stop = plant.drive().word();
        let refreshes = plant.refreshes(10);
        assert!(!plant.drive().runs, "{name}");
        for (_, pdu, _) in &refreshes {
            let word = plant.has_word(pdu);
            assert!(word.is_none_or(|word| word == stop), "{name}: {pdu:?}");
        }
        assert!(
            refreshes.len() >= 8,
            "{name}: {} {:?}",
            refreshes.len(),
            plant
                .rig
                .news
                .iter()
                .filter(|n| matches!(n, News::RefreshEnded { .. }))
                .collect::<Vec<_>>()
        );
    }
}

/// The write of a reference is on the wire when the port is lost: the drive may have it, so the older one is not repeated.
#[test]
fn an_order_that_is_cut_off_with_the_port_ends_the_refresh() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        assert!(!plant.refreshes(4).is_empty(), "{name}");
        let rig = &mut plant.rig;
        let _answer = rig.order(0, "client", ModelPoint::SpeedReference, Value::Number(20.0));
        let written = loop {
            let mut news = Vec::new();
            match rig.master.next(rig.now, &mut news) {
                Err(until) => rig.now = until,
                Ok(turn) if !matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write() => break turn,
                Ok(turn) => rig.carry_out(turn, &mut news),
            }
            news.iter().for_each(|one| rig.apply(one));
        };
        rig.master.sending(&written, rig.now);
        rig.drives[0].answer(written.pdu());
        rig.master.lost(rig.now);
        rig.master.opened(rig.now);
        plant.assert_ended("with an order of unknown outcome");
    }
}

/// A client that sets references faster than the status is read must not prevent the refresh of the control word.
#[test]
fn references_without_end_do_not_hold_up_the_word() {
    for (name, _) in FAMILIES.into_iter().filter(|(_, by_word)| *by_word) {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(Duration::from_secs(2));
        let (from, until) = (plant.rig.wire.len(), plant.rig.now + Duration::from_secs(6));
        let mut percent = 10.0;
        while plant.rig.now < until {
            percent = if percent > 40.0 { 10.0 } else { percent + 1.0 };
            plant.order(&[(ModelPoint::SpeedReference, Value::Number(percent))]);
            plant.rig.run(Duration::from_millis(150));
        }
        let wire = plant.rig.wire[from..].iter();
        let words = wire.filter(|(_, turn)| matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write());
        let words = words.filter(|(_, turn)| plant.has_word(&turn.pdu).is_some()).count();
        assert!(words >= 4, "{name}: {words} in 6 s");
    }
}

/// Events that end a refresh; only an order starts it again.
#[test]
fn a_refresh_ends_for_good_with_everything_that_contradicts_it() {
    type Event = fn(&mut Plant);
    let events: [(&str, Event); 7] = [
        ("panel stop", |plant| plant.drive().stand()),
        ("fault", |plant| plant.drive().show(ModelPoint::Fault, true)),
        ("local", |plant| plant.drive().show(ModelPoint::Remote, false)),
        ("power cycle", |plant| plant.drive().power_cycle()),
        ("outage", |plant| {
            plant.rig.drives[0].silent = true;
            plant.rig.run(Duration::from_secs(6));
            plant.rig.drives[0].silent = false;
        }),
        ("broadcast", |plant| {
            plant.rig.master.drives[0].foreign_order(false, plant.rig.now);
        }),
        ("lease", |plant| {
            let lease = Lease::held(plant.rig.now - Duration::from_secs(3601));
            plant.rig.master.drives[0].supervision.take_over(lease);
        }),
    ];
    for (name, _) in FAMILIES {
        for (event, happens) in &events {
            let mut plant = Plant::new(name);
            let point = |point| plant.profile.model_index(point).is_some();
            if *event == "local" && !point(ModelPoint::Remote) || *event == "fault" && !point(ModelPoint::Fault) {
                continue;
            }
            plant.starts();
            plant.rig.run(Duration::from_secs(5));
            assert!(plant.rig.bus.image.drives[0].is_refreshing(), "{name} {event}");
            happens(&mut plant);
            plant.assert_ended(event);
            // The refresh stays off after the cause has disappeared, too.
            plant.drive().show(ModelPoint::Fault, false);
            plant.drive().show(ModelPoint::Remote, true);
            assert!(
                plant.refreshes(5).is_empty(),
                "{name} {event}: it begins again by itself"
            );
            if *event == "power cycle" {
                assert!(!plant.drive().runs, "{name}");
                plant.drive().run();
                plant.order(&[(ModelPoint::SpeedReference, Value::Number(20.0))]);
                let refreshes = plant.refreshes(5);
                assert!(refreshes.is_empty(), "{name}: by a reference alone, {refreshes:?}");
            }
        }
    }
}

#[test]
fn from_the_acceptance_of_a_stop_no_run_word_is_repeated() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(Duration::from_secs(5));
        // The drive refuses the stop while it is busy.
        let from = plant.rig.wire.len();
        let _stop = plant.rig.switch(0, "client", false);
        plant.rig.drives[0].to_writes = Some((u32::MAX, Exception::BUSY));
        plant.rig.run(Duration::from_secs(5));
        let refreshed = plant.rig.wire[from..]
            .iter()
            .any(|(_, turn)| matches!(turn.purpose, Purpose::Refresh(_)));
        assert!(!refreshed && plant.drive().runs, "{name}");
        assert!(!plant.rig.bus.image.drives[0].is_refreshing(), "{name}");
    }
}

/// A drill ends an earlier refresh, keeps the drive's timeout from acting while its motor runs, and goes silent
/// when it tests that timeout.
#[test]
fn a_drill_feeds_the_timeout_until_it_tries_it() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(Duration::from_secs(3));
        let lock = |quiet_until: Option<Instant>| DrillLock {
            who: "drill".to_string(),
            quiet_until,
        };
        let set = |plant: &Plant, until| plant.rig.bus.queue.set_drill(DriveIndex::new(0), Some(lock(until)));
        set(&plant, None);
        plant.assert_ended("drill");
        let drill = || Origin::new(SourceKind::Mqtt, "client").of_drill("drill".to_string());
        plant.order_of(
            drill(),
            &[
                (ModelPoint::SpeedReference, Value::Number(20.0)),
                (ModelPoint::Run, Value::Bool(true)),
            ],
        );
        assert!(plant.refreshes(6).len() >= 4, "{name}");
        set(&plant, Some(plant.rig.now + Duration::from_secs(6)));
        let refreshes = plant.refreshes(6);
        assert!(refreshes.is_empty(), "{name}: {refreshes:?}");
        plant.order_of(drill(), &[(ModelPoint::Run, Value::Bool(false))]);
        assert!(!plant.drive().runs, "{name}");
    }
}

#[test]
fn another_masters_word_and_reference_stay() {
    for (name, by_word) in FAMILIES {
        let mut plant = Plant::new(name);
        let control = plant.profile.control.clone().unwrap();
        plant.starts();
        plant.rig.run(Duration::from_secs(5));
        if !control.is_read() || !by_word || control.own_word == drivegate_model::drive::control::OwnWord::Shadow {
            continue;
        }
        // Bits without a defined meaning, and the bit for the other direction.
        for bit in [0x0100u16, 0x0800, 0x0002] {
            let foreign = plant.drive().word() ^ bit;
            if control.is_stop(control.at, foreign) {
                continue;
            }
            plant.drive().write_word(foreign);
            let refreshes = plant.refreshes(8);
            assert!(
                refreshes.iter().all(|(_, pdu, _)| plant.has_word(pdu).is_none()),
                "{name} {foreign:#06x}: {refreshes:?}"
            );
            assert_eq!(plant.drive().word(), foreign, "{name}");
            plant.stops();
            plant.starts();
            plant.rig.run(Duration::from_secs(3));
        }
    }
}

#[test]
fn a_short_outage_suspends_a_refresh_and_it_goes_on_by_what_the_drive_shows() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(Duration::from_secs(5));
        plant.rig.drives[0].silent = true;
        plant.rig.run(Duration::from_millis(1500));
        plant.rig.drives[0].silent = false;
        plant.rig.run(Duration::from_millis(1500));
        let refreshes = plant.refreshes(5);
        assert!(refreshes.len() >= 4, "{name}: {}", refreshes.len());
    }
}

/// Stalls the thread of the bus for `ms` milliseconds.
fn stands_still(rig: &mut Rig, ms: u64) {
    let began = rig.now;
    rig.now += Duration::from_millis(ms);
    rig.master
        .after_stall(drivegate_core::stalls::Stall::new(began, rig.now), rig.now);
}

/// The reply to a read of a round that comes behind a short stall belongs to no step of the round, which begins again.
#[test]
fn a_stall_behind_the_request_of_a_round_ends_no_refresh() {
    let is_read = |turn: &Turn| matches!(turn.purpose, Purpose::Refresh(_)) && !turn.pdu.is_write();
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(EVERY * 3);
        for place in 0..4 {
            let until = plant.rig.now + Duration::from_secs(5);
            let from = plant.rig.wire.len();
            let seen = |plant: &Plant| plant.rig.wire[from..].iter().filter(|(_, turn)| is_read(turn)).count();
            while seen(&plant) < place {
                plant.rig.step();
                assert!(plant.rig.now < until, "{name}");
            }
            plant.rig.stalls = Some(is_read);
            plant.rig.run(Duration::from_secs(2));
            plant.rig.stalls = Some(|turn| matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write());
            let refreshes = plant.refreshes(5);
            assert!(refreshes.len() >= 4, "{name} {place}: {}", refreshes.len());
            assert!(plant.rig.bus.image.drives[0].is_refreshing(), "{name} {place}");
        }
    }
}

/// Values read in a round are no longer valid if the port was lost, or the thread was stalled, before the write of
/// the round.
#[test]
fn a_round_that_was_interrupted_reads_again_before_it_writes() {
    type Event = fn(&mut Rig);
    let events: [(&str, Event); 3] = [
        ("stall", |rig| stands_still(rig, 600)),
        ("port", |rig| {
            rig.master.lost(rig.now);
            rig.master.opened(rig.now);
        }),
        ("pause", |rig| stands_still(rig, 1100)),
    ];
    for (name, _) in FAMILIES {
        for (event, happens) in &events {
            let mut plant = Plant::new(name);
            plant.starts();
            let until = plant.rig.now + Duration::from_secs(5);
            let reads = |turn: &Turn| matches!(turn.purpose, Purpose::Refresh(_)) && !turn.pdu.is_write();
            while !plant.rig.wire.last().is_some_and(|(_, turn)| reads(turn)) {
                plant.rig.step();
                assert!(plant.rig.now < until, "{name}");
            }
            // The motor is at standstill now, which no read has shown yet.
            plant.drive().stand();
            happens(&mut plant.rig);
            let from = plant.rig.wire.len();
            plant.rig.run(Duration::from_secs(8));
            let writes = plant.rig.wire[from..]
                .iter()
                .filter(|(_, turn)| matches!(turn.purpose, Purpose::Refresh(_)));
            let words: Vec<Turn> = writes
                .map(|(_, turn)| turn.clone())
                .filter(|turn| turn.pdu.is_write() && plant.has_word(&turn.pdu).is_some())
                .collect();
            assert!(words.is_empty() && !plant.drive().runs, "{name} {event}: {words:?}");
        }
    }
}

#[test]
fn a_drive_that_knows_no_function_16_gets_both_apart() {
    let mut plant = Plant::new("abb-acs550");
    plant.drive().only_06 = true;
    plant.starts();
    let refreshes = plant.refreshes(10);
    let singles = refreshes
        .iter()
        .filter(|(_, pdu, _)| matches!(pdu, RequestPdu::WriteRegister { .. }));
    assert!(singles.count() >= 16, "{refreshes:?}");
    assert!(plant.drive().runs);
}

#[test]
fn what_was_handed_over_goes_on_with_a_lease_and_soon() {
    let mut plant = Plant::new("danfoss-fc");
    plant.starts();
    plant.rig.run(Duration::from_secs(5));
    let now = plant.rig.now;
    let handover = plant.rig.master.ended(None, now);
    assert_eq!(handover.leases.len(), 1);
    for alone in [false, true] {
        let carried = handover.leases[0];
        let before = Handover {
            leases: vec![if alone { carried.alone() } else { carried }],
            ..Handover::default()
        };
        plant.rig.begin_anew(&before);
        let refreshes = plant.refreshes(6);
        assert_eq!(refreshes.is_empty(), alone, "{refreshes:?}");
    }
}

/// The drive is too busy for the stop. The reset is ended before the stop is tried again; the word that ends the
/// reset contains no run command.
#[test]
fn no_end_of_a_reset_repeats_a_run_command_behind_a_stop() {
    let mut ends = 0;
    let resetting = [
        "vacon-cx",
        "eaton-hvx",
        "eaton-svx",
        "teco-7300pa",
        "fuji-frenic",
        "ls-g100",
    ];
    for name in FAMILIES.map(|(name, _)| name).into_iter().chain(resetting) {
        let mut plant = Plant::with(name, |spec| DriveSpec { refresh: None, ..spec });
        let control = plant.profile.control.clone().unwrap();
        plant.order(&[(ModelPoint::Run, Value::Bool(true))]);
        plant.rig.run(Duration::from_secs(1));
        let resets = control
            .fault_reset
            .is_some_and(|reset| reset.setting.place.is_none() && !reset.setting.once);
        if !resets {
            continue;
        }
        let from = plant.rig.wire.len();
        let _reset = plant.rig.order(0, "client", ModelPoint::FaultReset, Value::Bool(true));
        let reset = control.fault_reset.unwrap().setting;
        let until = plant.rig.now + Duration::from_secs(1);
        while !reset.holds(plant.drive().word()) && plant.rig.now < until {
            plant.rig.step();
        }
        if !reset.holds(plant.drive().word()) {
            // Refused: a reset would stop the motor.
            continue;
        }
        let stopped = plant.rig.wire.len();
        let _stop = plant.rig.switch(0, "client", false);
        plant.rig.drives[0].to_writes = Some((1, Exception::BUSY));
        plant.rig.run(Duration::from_secs(1));
        let words: Vec<u16> = plant.rig.wire[stopped..]
            .iter()
            .filter(|(_, turn)| turn.pdu.is_write())
            .filter_map(|(_, turn)| plant.has_word(&turn.pdu))
            .collect();
        let runs = words
            .iter()
            .any(|word| control.is_run(control.at, control.without_reset(*word)));
        assert!(
            !runs && !words.is_empty() && !plant.drive().runs,
            "{name}: {words:#06x?}, {:?}",
            &plant.rig.wire[from..]
        );
        ends += 1;
    }
    assert!(ends >= 3, "{ends}");
}
