//! Whether an order is still valid: its age, what has stopped its machine since, and whether its client is still connected.
//!
//! An order that was buffered while the reading thread did not run is as old as the stall, and its sequence is not
//! known. Pure: time is an argument.

use std::time::Instant;

use crate::order::{Arrival, Asks, LastStops, Order, Outcome};
use crate::permit::gate::{DriveGate, Gate};
use crate::permit::judge::{Ask, Rule, Stage, Verdict};
use crate::stalls::Stall;

pub(in crate::permit) const RULE: Rule = Rule {
    stages: &[Stage::Accept, Stage::Turn, Stage::Write],
    binds_stops: false,
    judge,
};

/// Effect of an order on a machine, as far as the age of the order matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum OrderKind {
    /// The order takes the run command away.
    Stop,
    /// The order can start a motor at standstill.
    Start,
    /// Does anything else, such as setting a reference.
    Other,
    /// The order only reads.
    Read,
}

/// The facts that decide about the age of an order.
#[derive(Debug, Clone, Copy)]
struct Age<'a> {
    /// When and over which connection the order arrived.
    arrival: &'a Arrival,
    /// Effect of the order.
    does: OrderKind,
    /// The order is not sent after this time.
    expires: Option<Instant>,
    /// The last stops of the machine.
    stops: &'a LastStops,
    /// The last pause of the thread that sends the order.
    waited: Option<Stall>,
}

fn judge(ask: &Ask<'_>, drive: &DriveGate, gate: &Gate) -> Verdict {
    let window = &ask.intent.window;
    let does = match (&ask.intent.order, ask.asks()) {
        (Order::Read(_), _) => OrderKind::Read,
        (_, Asks::Stop) => OrderKind::Stop,
        (_, Asks::Run) => OrderKind::Start,
        // A reference that turns a motor at standstill starts it.
        _ if ask.wakes() => OrderKind::Start,
        (_, Asks::Steer | Asks::Other | Asks::Nothing) => OrderKind::Other,
    };
    let age = Age {
        arrival: &window.arrival,
        does,
        // An order in progress keeps its own time limit, so that it still clears a reset bit that it has set.
        expires: (ask.stage != Stage::Write).then_some(window.expires),
        stops: &drive.last_stops,
        waited: gate.paused,
    };
    verdict(age, ask.now)
}

fn verdict(age: Age<'_>, now: Instant) -> Verdict {
    let Age { arrival, does, .. } = age;
    if does == OrderKind::Stop {
        return Verdict::Go;
    }
    if age.expires.is_some_and(|expires| expires <= now) {
        return Verdict::Refuse(Outcome::Expired);
    }
    // An order that waited while the bus did not run counts as given before the pause.
    let waited = age.waited.filter(|pause| arrival.asked < pause.ended);
    if arrival.connection.is_gone() && (arrival.stall.is_some() || waited.is_some()) {
        return Verdict::Refuse(Outcome::Expired);
    }
    let stopped = age.stops.of_others(&arrival.connection);
    if does != OrderKind::Read && stopped.is_some_and(|stopped| arrival.asked < stopped) {
        return Verdict::Refuse(Outcome::Purged);
    }
    if does != OrderKind::Start {
        return Verdict::Go;
    }
    let of_before = |pause: Stall| arrival.connection.opened_at() < pause.ended && now < pause.over();
    if arrival.pause.is_some_and(of_before) || waited.is_some_and(of_before) {
        return Verdict::Refuse(Outcome::Expired);
    }
    // A stop that arrived during the same stall may be read after this order.
    match arrival.stall.map(|stall| stall.read_by()) {
        Some(until) if now < until => Verdict::Wait(until),
        _ => Verdict::Go,
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::order::Connection;

    /// A time, in milliseconds after the process was started.
    fn at(start: Instant, ms: u64) -> Instant {
        start + Duration::from_millis(ms)
    }

    /// Times in ms: when the order arrived and expires; the stall during which it arrived; the last pause of its
    /// reader, and of the bus; when its connection was opened, and whether that is closed; a stop over this
    /// connection, and over another one; the time of the judgement.
    #[derive(Clone, Copy)]
    struct Case {
        asked: u64,
        expires: u64,
        stall: Option<(u64, u64)>,
        pause: Option<(u64, u64)>,
        waited: Option<(u64, u64)>,
        opened: u64,
        gone: bool,
        own_stop: Option<u64>,
        other_stop: Option<u64>,
        now: u64,
    }

    /// A healthy order, judged 100 ms after it arrived.
    const PLAIN: Case = Case {
        asked: 20_000,
        expires: 22_000,
        stall: None,
        pause: None,
        waited: None,
        opened: 0,
        gone: false,
        own_stop: None,
        other_stop: None,
        now: 20_100,
    };

    /// [`PLAIN`], read after a stall of 200 ms.
    const HICCUP: Case = Case {
        stall: Some((20_000, 20_200)),
        now: 20_201,
        ..PLAIN
    };

    /// [`PLAIN`], read after a pause of 1.5 s.
    const PAUSED: Case = Case {
        stall: Some((20_000, 21_500)),
        pause: Some((20_000, 21_500)),
        now: 21_501,
        ..PLAIN
    };

    /// The verdict on a stop, a start, a reference, and a read.
    fn verdicts(case: Case) -> String {
        let start = Instant::now();
        let stall = |(began, ended): (u64, u64)| Stall::new(at(start, began), at(start, ended));
        let connection = Connection::opened(at(start, case.opened));
        if case.gone {
            connection.hang_up();
        }
        let mut stops = LastStops::default();
        let other = Connection::opened(start);
        let mut both = [(case.own_stop, &connection), (case.other_stop, &other)];
        both.sort_by_key(|(at, _)| *at);
        for (stopped, by) in both {
            stopped.into_iter().for_each(|ms| stops.note(by, at(start, ms)));
        }
        let arrival = Arrival {
            asked: at(start, case.asked),
            connection: connection.clone(),
            stall: case.stall.map(stall),
            pause: case.pause.map(stall),
        };
        let all = [OrderKind::Stop, OrderKind::Start, OrderKind::Other, OrderKind::Read].map(|does| {
            let age = Age {
                arrival: &arrival,
                does,
                expires: Some(at(start, case.expires)),
                stops: &stops,
                waited: case.waited.map(stall),
            };
            match verdict(age, at(start, case.now)) {
                Verdict::Go => "go".to_string(),
                Verdict::Wait(until) => format!("wait {}", until.duration_since(start).as_millis()),
                Verdict::Refuse(outcome) => outcome.code().to_string(),
                Verdict::LookFirst => "look first".to_string(),
            }
        });
        all.join(", ")
    }

    #[test]
    fn what_becomes_of_a_stop_a_start_a_reference_and_a_read() {
        let table = [
            ("a healthy one", PLAIN, "go, go, go, go"),
            ("the last moment", Case { now: 21_999, ..PLAIN }, "go, go, go, go"),
            ("late", Case { now: 22_000, ..PLAIN }, "go, expired, expired, expired"),
            (
                "a client that closed after it",
                Case { gone: true, ..PLAIN },
                "go, go, go, go",
            ),
            (
                "a stop by another one before",
                Case {
                    other_stop: Some(20_000),
                    ..PLAIN
                },
                "go, go, go, go",
            ),
            (
                "a stop by another one since",
                Case {
                    other_stop: Some(20_001),
                    ..PLAIN
                },
                "go, purged, purged, go",
            ),
            (
                "one of its own, read before it",
                Case {
                    own_stop: Some(20_050),
                    ..PLAIN
                },
                "go, go, go, go",
            ),
            (
                "one of its own, and one of another since",
                Case {
                    own_stop: Some(20_050),
                    other_stop: Some(20_010),
                    ..PLAIN
                },
                "go, purged, purged, go",
            ),
            (
                "the other's was before",
                Case {
                    own_stop: Some(20_050),
                    other_stop: Some(19_000),
                    ..PLAIN
                },
                "go, go, go, go",
            ),
            ("during a hiccup", HICCUP, "go, wait 20450, go, go"),
            ("when that is read", Case { now: 20_450, ..HICCUP }, "go, go, go, go"),
            (
                "a stop read before it",
                Case {
                    other_stop: Some(20_201),
                    ..HICCUP
                },
                "go, purged, purged, go",
            ),
            (
                "a stop read after it",
                Case {
                    other_stop: Some(20_300),
                    now: 20_301,
                    ..HICCUP
                },
                "go, purged, purged, go",
            ),
            (
                "a stop of long before",
                Case {
                    other_stop: Some(19_900),
                    ..HICCUP
                },
                "go, wait 20450, go, go",
            ),
            (
                "its own order counts",
                Case {
                    own_stop: Some(20_201),
                    ..HICCUP
                },
                "go, wait 20450, go, go",
            ),
            (
                "its client has gone",
                Case { gone: true, ..HICCUP },
                "go, expired, expired, expired",
            ),
            ("after a pause", PAUSED, "go, expired, go, go"),
            (
                "its client has gone in the pause",
                Case { gone: true, ..PAUSED },
                "go, expired, expired, expired",
            ),
            (
                "a pause of three seconds",
                Case {
                    stall: Some((20_000, 23_000)),
                    pause: Some((20_000, 23_000)),
                    now: 23_001,
                    ..PLAIN
                },
                "go, expired, expired, expired",
            ),
            (
                "sent later over an old connection",
                Case {
                    asked: 23_000,
                    expires: 25_000,
                    stall: None,
                    now: 23_001,
                    ..PAUSED
                },
                "go, expired, go, go",
            ),
            (
                "as long again and a second after the pause",
                Case {
                    asked: 24_000,
                    expires: 26_000,
                    stall: None,
                    now: 24_000,
                    ..PAUSED
                },
                "go, go, go, go",
            ),
            (
                "over a new connection",
                Case {
                    asked: 21_600,
                    expires: 23_600,
                    stall: None,
                    opened: 21_550,
                    now: 21_600,
                    ..PAUSED
                },
                "go, go, go, go",
            ),
            (
                "a new connection of which the process read late",
                Case {
                    opened: 21_500,
                    ..PAUSED
                },
                "go, wait 21750, go, go",
            ),
            (
                "it waited for its turn while the bus paused",
                Case {
                    waited: Some((20_050, 21_100)),
                    now: 21_100,
                    ..PLAIN
                },
                "go, expired, go, go",
            ),
            (
                "and its client has gone",
                Case {
                    waited: Some((20_050, 21_100)),
                    now: 21_100,
                    gone: true,
                    ..PLAIN
                },
                "go, expired, expired, expired",
            ),
            (
                "the bus paused before it came",
                Case {
                    waited: Some((18_000, 19_999)),
                    ..PLAIN
                },
                "go, go, go, go",
            ),
        ];
        for (what, case, expected) in table {
            assert_eq!(verdicts(case), expected, "{what}");
        }
    }
}
