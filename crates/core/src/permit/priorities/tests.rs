use super::*;
use Commanded::{FrequencyReference, Reverse, Run, SpeedReference};

const NULL: Option<f64> = None;

fn client(name: &str) -> Origin {
    Origin::new(SourceKind::Bacnet, name)
}

fn effect(run: Option<bool>, reference: bool) -> Effect {
    Effect {
        run,
        reference,
        ..Effect::default()
    }
}

/// Accepts and carries out a write; returns the resulting orders as point, value and owner.
fn write(all: &mut Priorities, what: Commanded, who: &str, priority: u8, value: Option<f64>) -> String {
    let write = asked(all, what, who, priority, value);
    all.settle(write.1.id, Settled::Done, Instant::now());
    write.0
}

/// Writes a slot without settling the result.
fn asked(all: &mut Priorities, what: Commanded, who: &str, priority: u8, value: Option<f64>) -> (String, SlotWrite) {
    let value = value.map(|number| match what {
        Run | Reverse => Value::Bool(number != 0.0),
        SpeedReference | FrequencyReference => Value::Number(number),
    });
    let entry = value.map(|value| Entry::new(value, client(who), Instant::now()));
    let write = SlotWrite::new(what, priority, entry);
    let follows = match all.plan(&write) {
        Follows::Nothing => "nothing".to_string(),
        Follows::Stop => "stop".to_string(),
        Follows::Order(what, entry) => format!("{}={} by {}", what.point().name(), entry.value, entry.origin.who),
    };
    all.ask(&write);
    (follows, write)
}

fn standing(all: &Priorities, what: Commanded) -> Vec<(u8, f64)> {
    let one = |priority| Some((priority, all.entry(what, priority)?.value.as_f64()));
    (1..=16).filter_map(one).collect()
}

fn elsewhere(all: &mut Priorities, kind: SourceKind, effect: Effect) -> bool {
    let origin = Origin::new(kind, "x");
    let refused = all.refuses(&origin, effect).is_some();
    if !refused {
        all.accepted(&origin, effect, None, Instant::now());
    }
    !refused
}

#[test]
fn the_lowest_occupied_slot_governs() {
    let mut all = Priorities::default();
    assert_eq!(write(&mut all, Run, "a", 8, Some(1.0)), "run=true by a");
    assert_eq!(write(&mut all, Run, "b", 10, Some(0.0)), "nothing");
    assert_eq!(write(&mut all, Run, "c", 5, Some(0.0)), "run=false by c");
    assert_eq!(write(&mut all, Run, "a", 8, Some(1.0)), "nothing");
    assert_eq!(write(&mut all, Run, "c", 4, NULL), "nothing", "was empty");
    assert_eq!(write(&mut all, Run, "c", 5, NULL), "run=true by a");
    assert_eq!(write(&mut all, Run, "a", 8, NULL), "run=false by b");
    assert_eq!(write(&mut all, Run, "b", 10, NULL), "stop", "the last one");
    assert!(all.arrays.is_none());
    assert_eq!(write(&mut all, Reverse, "a", 8, Some(1.0)), "reverse=true by a");
    assert_eq!(write(&mut all, Reverse, "a", 8, NULL), "nothing");
}

#[test]
fn both_references_are_one_thing_to_the_drive() {
    let mut all = Priorities::default();
    assert_eq!(
        write(&mut all, SpeedReference, "a", 8, Some(50.0)),
        "speed_reference=50 by a"
    );
    assert_eq!(write(&mut all, FrequencyReference, "b", 9, Some(20.0)), "nothing");
    assert_eq!(
        write(&mut all, FrequencyReference, "b", 8, Some(21.0)),
        "frequency_reference=21 by b"
    );
    assert_eq!(all.shown(SpeedReference), None);
    assert_eq!(all.shown(FrequencyReference).map(|(priority, _)| priority), Some(8));
    assert_eq!(
        write(&mut all, SpeedReference, "a", 8, Some(51.0)),
        "speed_reference=51 by a",
        "the later one"
    );
    assert_eq!(write(&mut all, FrequencyReference, "b", 8, NULL), "nothing");
    assert_eq!(
        write(&mut all, SpeedReference, "a", 8, NULL),
        "frequency_reference=20 by b"
    );
    assert_eq!(
        write(&mut all, FrequencyReference, "b", 9, NULL),
        "nothing",
        "the drive keeps it"
    );
}

#[test]
fn a_stop_from_elsewhere_empties_every_active() {
    let kinds = [
        SourceKind::Mqtt,
        SourceKind::ModbusTcp,
        SourceKind::Slot,
        SourceKind::Shutdown,
    ];
    for kind in kinds {
        let mut all = Priorities::default();
        write(&mut all, Run, "a", 3, Some(1.0));
        write(&mut all, Run, "b", 8, Some(1.0));
        write(&mut all, Run, "c", 9, Some(0.0));
        write(&mut all, SpeedReference, "a", 8, Some(50.0));
        let (_, pending) = asked(&mut all, Run, "a", 2, Some(1.0));
        assert!(elsewhere(&mut all, kind, effect(Some(false), false)));
        all.settle(pending.id, Settled::Done, Instant::now());
        assert_eq!(standing(&all, Run), [(9, 0.0)], "{kind:?}");
        assert_eq!(standing(&all, SpeedReference), [(8, 50.0)]);
        assert_eq!(
            write(&mut all, Run, "c", 9, NULL),
            "stop",
            "nothing starts later by itself"
        );
    }
}

#[test]
fn an_inactive_that_protects_refuses_starts_from_elsewhere() {
    for (priority, protects) in [(1, true), (5, true), (6, false), (16, false)] {
        let mut all = Priorities::default();
        write(&mut all, Run, "guard", priority, Some(0.0));
        for kind in [SourceKind::Mqtt, SourceKind::Slot, SourceKind::LocalSocket] {
            let held = all.refuses(&Origin::new(kind, "x"), effect(Some(true), false));
            assert_eq!(
                held.map(|held| (held.client, held.priority)),
                protects.then(|| ("guard".to_string(), priority))
            );
        }
        assert!(
            all.refuses(&client("b"), effect(Some(true), false)).is_none(),
            "slots decide among themselves"
        );
        assert!(
            all.refuses(&Origin::new(SourceKind::Mqtt, "x"), effect(Some(false), true))
                .is_none(),
            "a stop"
        );
        assert_eq!(
            elsewhere(&mut all, SourceKind::Mqtt, effect(Some(true), false)),
            !protects
        );
        assert_eq!(standing(&all, Run).is_empty(), !protects);
    }
}

#[test]
fn a_reference_from_elsewhere_withdraws_those_that_do_not_protect() {
    let mut all = Priorities::default();
    write(&mut all, SpeedReference, "a", 8, Some(50.0));
    write(&mut all, FrequencyReference, "a", 16, Some(20.0));
    assert!(elsewhere(&mut all, SourceKind::Http, effect(None, true)));
    assert!(all.arrays.is_none());
    write(&mut all, FrequencyReference, "a", 4, Some(20.0));
    assert!(!elsewhere(&mut all, SourceKind::Http, effect(None, true)));
    assert!(
        elsewhere(&mut all, SourceKind::Supervision, effect(None, true)),
        "the gateway itself is not refused"
    );
    assert!(elsewhere(&mut all, SourceKind::Http, effect(None, true)));
}

/// The slots of both arrays that remain after an order from elsewhere, at each priority, when an active value governs.
#[test]
fn what_protects_people_stays_also_behind_an_active_that_governs() {
    for priority in 2..=16 {
        let stays = priority <= PROTECTING;
        for kind in [
            SourceKind::Mqtt,
            SourceKind::ModbusTcp,
            SourceKind::Slot,
            SourceKind::Http,
        ] {
            let mut all = Priorities::default();
            write(&mut all, Run, "a", 1, Some(1.0));
            write(&mut all, Run, "guard", priority, Some(0.0));
            let (_, pending) = asked(&mut all, Run, "guard", 16, Some(0.0));
            assert!(elsewhere(&mut all, kind, effect(Some(true), false)));
            all.settle(pending.id, Settled::Done, Instant::now());
            let left = if stays {
                vec![(1, 1.0), (priority, 0.0)]
            } else {
                vec![(1, 1.0)]
            };
            assert_eq!(standing(&all, Run), left, "{kind:?} at {priority}");
            // An inactive that stays governs as soon as the active is given back, and then refuses starts.
            write(&mut all, Run, "a", 1, NULL);
            assert_eq!(elsewhere(&mut all, kind, effect(Some(true), false)), !stays);
        }
    }
    // A reference of the gateway itself is not refused, and keeps the value of another client that protects people.
    for priority in 1..=16 {
        let mut all = Priorities::default();
        write(&mut all, Run, "silent", 8, Some(1.0));
        write(&mut all, SpeedReference, "guard", priority, Some(20.0));
        assert!(elsewhere(&mut all, SourceKind::Supervision, effect(None, true)));
        assert_eq!(
            standing(&all, SpeedReference).len(),
            usize::from(priority <= PROTECTING)
        );
        assert_eq!(standing(&all, Run), [], "the lease of its client ended");
    }
}

#[test]
fn what_nobody_may_release_is_void() {
    let mut all = Priorities::default();
    let now = Instant::now();
    write(&mut all, Run, "gone", 3, Some(0.0));
    write(&mut all, Run, "stays", 8, Some(1.0));
    write(&mut all, SpeedReference, "gone", 8, Some(50.0));
    let (_, under_way) = asked(&mut all, Reverse, "gone", 9, Some(1.0));
    let (_, uncertain) = asked(&mut all, FrequencyReference, "gone", 16, Some(5.0));
    all.settle(uncertain.id, Settled::Unknown, now);
    // A slot with a pending release by its client counts as released.
    write(&mut all, Run, "gone", 12, Some(0.0));
    let (_, null) = asked(&mut all, Run, "gone", 12, NULL);
    let keeps = |what: Commanded, entry: &Entry| what == Run && entry.origin.who == "stays";
    let void: Vec<(Commanded, u8)> = all
        .end_without_right(keeps)
        .into_iter()
        .map(|void| (void.what, void.priority))
        .collect();
    assert_eq!(
        void,
        [
            (Run, 3),
            (Run, 12),
            (Reverse, 9),
            (SpeedReference, 8),
            (FrequencyReference, 16)
        ]
    );
    all.settle(under_way.id, Settled::Done, now);
    all.settle(null.id, Settled::Done, now);
    all.resolve(|_, _| Some(Value::Number(5.0)));
    assert_eq!(standing(&all, Run), [(8, 1.0)]);
    assert!(
        [Reverse, SpeedReference, FrequencyReference]
            .iter()
            .all(|what| standing(&all, *what).is_empty())
    );
    assert!(all.end_without_right(keeps).is_empty(), "each is told once");
    assert!(elsewhere(&mut all, SourceKind::Mqtt, effect(Some(true), false)));
}

#[test]
fn a_lease_that_ends_empties_all_slots_of_its_client() {
    let mut all = Priorities::default();
    write(&mut all, Run, "a", 8, Some(1.0));
    write(&mut all, SpeedReference, "a", 8, Some(50.0));
    write(&mut all, Run, "b", 9, Some(0.0));
    write(&mut all, Run, "b", 10, Some(1.0));
    assert_eq!(
        all.client().map(|client| client.to_string()),
        Some("bacnet a".to_string())
    );
    assert!(elsewhere(&mut all, SourceKind::Supervision, effect(Some(false), false)));
    assert_eq!(
        (standing(&all, Run), standing(&all, SpeedReference)),
        (vec![(9, 0.0)], vec![])
    );
}

#[test]
fn what_is_asked_for_counts_and_is_not_shown_before_it_is_done() {
    let now = Instant::now();
    let mut all = Priorities::default();
    let (_, stop) = asked(&mut all, Run, "a", 8, Some(0.0));
    assert_eq!(standing(&all, Run), []);
    let (follows, start) = asked(&mut all, Run, "b", 10, Some(1.0));
    assert_eq!(follows, "nothing", "the stop is on its way");
    all.settle(start.id, Settled::Done, now);
    all.settle(stop.id, Settled::Failed, now);
    assert_eq!(standing(&all, Run), [(10, 1.0)], "as it was");
    let (_, first) = asked(&mut all, Run, "a", 8, Some(1.0));
    let (_, second) = asked(&mut all, Run, "a", 8, Some(0.0));
    all.settle(second.id, Settled::Done, now);
    all.settle(first.id, Settled::Done, now);
    assert_eq!(standing(&all, Run), [(8, 0.0), (10, 1.0)], "the later write stands");
}

#[test]
fn what_is_not_known_is_what_the_next_reading_shows() {
    let now = Instant::now();
    for (read, shown) in [(true, vec![(8, 1.0)]), (false, vec![])] {
        let mut all = Priorities::default();
        let (_, start) = asked(&mut all, Run, "a", 8, Some(1.0));
        all.settle(start.id, Settled::Unknown, now);
        assert_eq!((standing(&all, Run), all.is_uncertain()), (vec![], true));
        all.resolve(|_, _| None);
        assert!(all.is_uncertain());
        all.resolve(|what, since| (what == Run && since == now).then_some(Value::Bool(read)));
        assert_eq!((standing(&all, Run), all.is_uncertain()), (shown, false));
    }
}

#[test]
fn inactives_that_protect_outlive_a_restart() {
    let mut all = Priorities::default();
    for (priority, on) in [(1, 1.0), (3, 0.0), (5, 0.0), (8, 0.0)] {
        write(&mut all, Run, "a", priority, Some(on));
    }
    let kept: Vec<(u8, Entry)> = all.kept().map(|(priority, entry)| (priority, entry.clone())).collect();
    assert_eq!(kept.iter().map(|(priority, _)| *priority).collect::<Vec<_>>(), [3, 5]);
    let mut later = Priorities::default();
    kept.into_iter()
        .for_each(|(priority, entry)| later.restore(Run, priority, entry));
    assert!(!elsewhere(&mut later, SourceKind::Mqtt, effect(Some(true), false)));
}

#[test]
fn outcomes_settle_slots() {
    use crate::order::{Interruption, Refusal};
    let cases = [
        (Outcome::Acknowledged(drivegate_proto::Reply::Written), Settled::Done),
        (Outcome::TimedOut, Settled::Unknown),
        (Outcome::Interrupted(Interruption::Stop), Settled::Unknown),
        (Outcome::Purged, Settled::Failed),
        (Outcome::Refused(Refusal::NotAllowed(String::new())), Settled::Failed),
    ];
    for (outcome, settled) in cases {
        assert_eq!(Settled::of(&outcome), settled);
    }
}

#[test]
fn a_stop_is_what_leaves_no_active_to_govern() {
    let mut all = Priorities::default();
    assert!(all.stops(16, Some(false)) && all.stops(16, None), "without any slot");
    assert!(!all.stops(1, Some(true)));
    write(&mut all, Run, "a", 8, Some(1.0));
    assert!(all.stops(8, Some(false)) && all.stops(1, Some(false)) && all.stops(8, None));
    assert!(!all.stops(9, Some(false)), "it does not govern");
    write(&mut all, Run, "b", 5, Some(0.0));
    assert!(!all.stops(5, None), "it hands over to an active");
    assert!(all.stops(8, None), "it gives nobody anything");
}

#[test]
fn an_order_that_was_planned_follows_only_from_what_still_stands() {
    let mut all = Priorities::default();
    write(&mut all, Run, "a", 8, Some(1.0));
    write(&mut all, Run, "b", 5, Some(0.0));
    let null = SlotWrite::new(Run, 5, None);
    let Follows::Order(_, entry) = all.plan(&null) else {
        panic!()
    };
    let null = null.governed_by(&entry);
    assert!(all.still_follows(&null));
    let mut stopped = all.clone();
    assert!(elsewhere(&mut stopped, SourceKind::Mqtt, effect(Some(false), false)));
    assert!(!stopped.still_follows(&null), "a stop withdrew the active");
    write(&mut all, Run, "c", 8, Some(1.0));
    assert!(!all.still_follows(&null), "it is another one's order");
}

#[test]
fn what_is_recorded_of_an_order_keeps_no_right_in_memory() {
    use crate::order::Right;
    use std::sync::Arc;
    use std::sync::atomic::AtomicBool;
    let grants = Arc::new(AtomicBool::new(true));
    let origin = client("a").with_right(Right::of(grants.clone()));
    let mut gate = crate::permit::Gate::default();
    gate.stop_joined(drivegate_model::drive::DriveIndex::new(0), &origin, Instant::now());
    drop(origin);
    assert_eq!(
        Arc::strong_count(&grants),
        1,
        "the right, and with it the plant, is never freed"
    );
}
