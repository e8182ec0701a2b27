//! Words that are never repeated, and orders after which nothing is.

use super::*;
use drivegate_model::drive::RawWrites;

impl Plant {
    /// Writes the control word as a client that knows the drive's own register.
    fn writes_word(&mut self, word: u16) -> Receiver<Answer> {
        let at = self.profile.control.as_ref().unwrap().at;
        let order = Order::Write(self.profile.functions.write_register(at.address, word));
        let origin = Origin::new(SourceKind::ModbusTcp, "client");
        let now = self.rig.now;
        submit(
            &self.rig.bus,
            DriveIndex::new(0),
            origin,
            order,
            window(now, DEFAULT_EXPIRY),
            now,
        )
    }

    fn that_takes_raw_writes(name: &'static str) -> Plant {
        Plant::with(name, |spec| DriveSpec {
            raw_writes: RawWrites::All,
            ..spec
        })
    }
}

/// What feeds the timeout of a drive needs a lease of its own.
#[test]
fn nothing_is_repeated_without_a_lease() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::with(name, |spec| DriveSpec {
            supervision: None,
            ..spec
        });
        plant.starts();
        let refreshes = plant.refreshes(6);
        assert!(refreshes.is_empty(), "{name}: {refreshes:?}");
    }
}

/// A bit that `[control]` gives no meaning may jog the motor.
#[test]
fn a_word_with_a_bit_that_has_no_meaning_is_not_repeated() {
    let mut tried = 0;
    for (name, _) in FAMILIES.into_iter().filter(|(_, by_word)| *by_word) {
        let mut plant = Plant::that_takes_raw_writes(name);
        let control = plant.profile.control.clone().unwrap();
        plant.starts();
        plant.rig.run(Duration::from_secs(3));
        let (word, known) = (plant.drive().word(), control.known_bits());
        let jogs = (0..16).map(|bit| word | 1 << bit).find(|other| {
            let new = other & !word;
            let resets = control.without_reset(*other) != *other;
            new != 0 && new & known == 0 && !resets && control.is_run(control.at, *other)
        });
        let Some(jogs) = jogs else { continue };
        let mut answer = plant.writes_word(jogs);
        plant.rig.run(Duration::from_secs(2));
        if !outcome(&mut answer).is_some_and(|outcome| outcome.is_ok()) {
            continue;
        }
        tried += 1;
        assert_eq!(plant.drive().word(), jogs, "{name}");
        let refreshes = plant.refreshes(6);
        let again = refreshes.iter().any(|(_, pdu, _)| plant.has_word(pdu).is_some());
        assert!(!again, "{name} {jogs:#06x}: {refreshes:?}");
    }
    assert!(tried >= 3, "{tried}");
}

/// A word that stops by other means, as a coast or a quick stop, may start the motor again when the next word comes.
#[test]
fn nothing_is_repeated_behind_a_word_that_stops_by_other_means() {
    let mut tried = 0;
    for (name, _) in FAMILIES {
        let control = drivegate_testkit::profile(name).control.clone().unwrap();
        for stop in &control.also_stop {
            let mut plant = Plant::that_takes_raw_writes(name);
            plant.starts();
            plant.rig.run(Duration::from_secs(3));
            let word = stop.applied(plant.drive().word());
            if control.is_own_stop(control.at, word) {
                continue;
            }
            let mut answer = plant.writes_word(word);
            plant.rig.run(Duration::from_secs(2));
            let outcome = outcome(&mut answer);
            assert!(
                outcome.as_ref().is_some_and(Outcome::is_ok),
                "{name} {word:#06x}: {outcome:?}"
            );
            let refreshes = plant.refreshes(6);
            assert!(refreshes.is_empty(), "{name} {word:#06x}: {refreshes:?}");
            tried += 1;
        }
    }
    assert!(tried >= 8, "{tried}");
}

/// A motor that stands by a stop is run by somebody else: what the stop repeats must not stop it.
#[test]
fn a_stop_is_not_repeated_to_a_motor_that_starts() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.stops();
        assert!(plant.refreshes(4).len() >= 2, "{name}: a stop is repeated");
        plant.drive().run();
        plant.assert_ended("run by somebody else");
    }
}

/// Events after which the state of the drive is another than the repeated one, or is not known.
#[test]
fn a_refresh_ends_with_what_is_not_an_order_of_a_client() {
    type Event = fn(&mut Plant);
    let events: [(&str, Event); 3] = [
        ("an order whose outcome is unknown", |plant| {
            plant.rig.drives[0].silent = true;
            let _answer = plant
                .rig
                .order(0, "client", ModelPoint::SpeedReference, Value::Number(30.0));
            plant.rig.run(Duration::from_millis(1_500));
            plant.rig.drives[0].silent = false;
        }),
        ("restore", |plant| {
            plant.rig.bus.image.drives[0]
                .restore_lock
                .set(Some("restore".to_string()));
            plant.rig.run(Duration::from_secs(2));
            plant.rig.bus.image.drives[0].restore_lock.set(None);
        }),
        ("restart", |plant| plant.rig.master.drives[0].restarted()),
    ];
    for (name, _) in FAMILIES {
        for (event, happens) in &events {
            let mut plant = Plant::new(name);
            plant.starts();
            plant.rig.run(Duration::from_secs(5));
            happens(&mut plant);
            plant.assert_ended(event);
        }
    }
}

/// An answer that is lost is not asked for again before the next period.
#[test]
fn a_refresh_that_is_not_answered_is_not_tried_again_at_once() {
    for (name, _) in FAMILIES {
        let mut plant = Plant::new(name);
        plant.starts();
        plant.rig.run(Duration::from_secs(3));
        let from = plant.rig.wire.len();
        plant.rig.drives[0].to_writes = Some((u32::MAX, Exception::BUSY));
        plant.rig.run(Duration::from_millis(2_500));
        let wire = plant.rig.wire[from..].iter();
        let writes = wire.filter(|(_, turn)| matches!(turn.purpose, Purpose::Refresh(_)) && turn.pdu.is_write());
        let writes: Vec<Instant> = writes.map(|(at, _)| *at).collect();
        let shortest = writes.windows(2).map(|pair| pair[1] - pair[0]).min();
        assert!(!writes.is_empty(), "{name}");
        assert!(shortest.is_none_or(|time| time >= EVERY), "{name}: {writes:?}");
    }
}

/// An order to run at another reference, whose time is over when the drive has taken the reference: what the drive has is known,
/// and the motor that runs is fed further.
#[test]
fn an_order_that_expires_half_done_ends_no_refresh() {
    let mut plant = Plant::new("vacon-nx");
    plant.starts();
    plant.rig.run(Duration::from_secs(3));
    let image = plant.rig.bus.image.drives[0].clone();
    let index = |point| image.spec.profile.model_index(point).unwrap();
    let half = (0..50u32).any(|number| {
        let points = [
            (
                index(ModelPoint::SpeedReference),
                Value::Number(20.0 + f64::from(number)),
            ),
            (index(ModelPoint::Run), Value::Bool(true)),
        ];
        let origin = Origin::new(SourceKind::Mqtt, "client");
        let now = plant.rig.now;
        let window = window(now, Duration::from_millis(2 + u64::from(number)));
        let order = Order::Points(points.to_vec());
        let mut answer = submit(&plant.rig.bus, DriveIndex::new(0), origin, order, window, now);
        plant.rig.run(Duration::from_millis(330));
        matches!(outcome(&mut answer), Some(Outcome::Interrupted(_)))
    });
    assert!(half, "no order was half done when its time was over");
    let refreshes = plant.refreshes(5);
    assert!(refreshes.len() >= 6, "{refreshes:?}");
    assert!(plant.rig.bus.image.drives[0].is_refreshing());
}
