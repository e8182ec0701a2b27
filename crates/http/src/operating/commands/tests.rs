use drivegate_north::NorthState;
use std::time::Duration;

use drivegate_testkit::next_command;

use super::*;
use crate::operating::state::IN_PROGRESS;
use drivegate_core::plant::OrderRequest;

fn operator(user: &str, login: &str) -> Operator {
    Operator {
        user: user.into(),
        login: login.into(),
        address: [192, 0, 2, 1].into(),
        kind: SourceKind::Http,
        proof: drivegate_core::order::Proof::User(user.into()),
        right: drivegate_core::order::Right::lasting(),
        cookie: None,
    }
}

/// A plant whose drive `p1` is read at `now`, a user, and the time.
struct OperatedPlant {
    operating: Operating,
    plant: Plant,
    now: Instant,
}

impl OperatedPlant {
    fn new() -> OperatedPlant {
        let (plant, now) = (drivegate_testkit::nx_plant(&["p1", "p2"]), Instant::now());
        for drive in ["p1", "p2"] {
            drivegate_testkit::read_nx(&plant, drive, 0b11, 0, now);
        }
        OperatedPlant {
            operating: Operating::new(&NorthState::default()),
            plant,
            now,
        }
    }

    fn take(&self, operator: &Operator, drive: &str, body: &str) -> Progress {
        let time = SystemTime::UNIX_EPOCH;
        self.operating.take(
            &self.plant,
            operator,
            drive,
            body.as_bytes(),
            (Arrival::now(self.now), self.now, time),
        )
    }

    fn waiting(&self) -> usize {
        self.plant.buses[0].queue.lock().len()
    }
}

fn refused(progress: Progress) -> (StatusCode, String) {
    match progress {
        Progress::Known(reply) => (reply.status, String::from_utf8(reply.body).unwrap()),
        Progress::Repeated(_) => panic!("repeated"),
        Progress::Placed(_) => panic!("placed"),
    }
}

#[test]
fn no_stop_is_refused_for_what_waits() {
    let rig = OperatedPlant::new();
    let alice = operator("alice", "alice#1");
    let mut kept = Vec::new();
    for number in 0..IN_PROGRESS {
        kept.push(rig.take(&alice, "p2", &format!("{{\"speed_reference\": {}}}", number % 90)));
    }
    let (status, body) = refused(rig.take(&alice, "p2", "{\"speed_reference\": 1}"));
    assert_eq!(status, StatusCode::FORBIDDEN);
    assert!(
        body.contains("too many commands are waiting for their results; nothing was written"),
        "{body}"
    );
    for _ in 0..100 {
        let stop = rig.take(&alice, "p1", "{\"run\": false}");
        assert!(matches!(stop, Progress::Placed(waiting) if waiting.shared.is_none()));
    }
    assert!(rig.waiting() >= 1);
}

#[test]
fn a_repetition_is_recognised_by_user_drive_and_content() {
    let mut rig = OperatedPlant::new();
    let (alice, again, bob) = (
        operator("alice", "alice#1"),
        operator("alice", "alice#2"),
        operator("bob", "bob#3"),
    );
    let body = "{\"id\": 1, \"speed_reference\": 10}";
    let _first = rig.take(&alice, "p1", body);
    assert!(matches!(rig.take(&alice, "p1", body), Progress::Repeated(_)));
    assert!(
        matches!(rig.take(&again, "p1", body), Progress::Repeated(_)),
        "the same user"
    );
    let others = [
        rig.take(&bob, "p1", body),
        rig.take(&alice, "p2", body),
        rig.take(&alice, "p1", "{\"id\": 1, \"speed_reference\": 11}"),
        rig.take(&alice, "p1", "{\"speed_reference\": 10}"),
        rig.take(&alice, "p1", "{\"speed_reference\": 10}"),
    ];
    assert!(others.iter().all(|one| matches!(one, Progress::Placed(_))));
    let (status, text) = refused(rig.take(&alice, "p1", body));
    assert!(
        status == StatusCode::FORBIDDEN && text.contains("`id` was used for another command"),
        "{text}"
    );
    rig.now += 2 * command_json::REMEMBERED;
    drivegate_testkit::read_nx(&rig.plant, "p1", 0b11, 0, rig.now);
    assert!(
        matches!(rig.take(&alice, "p1", body), Progress::Placed(_)),
        "it is forgotten"
    );
}

#[test]
fn a_repetition_is_known_to_the_server_that_a_reload_starts() {
    let (mut rig, north) = (OperatedPlant::new(), NorthState::default());
    let alice = operator("alice", "alice#1");
    let body = "{\"id\": 1, \"speed_reference\": 10}";
    rig.operating = Operating::new(&north);
    let _first = rig.take(&alice, "p1", body);
    rig.operating = Operating::new(&north);
    assert!(matches!(rig.take(&alice, "p1", body), Progress::Repeated(_)));
}

#[test]
fn a_lease_is_renewed_by_the_login_that_commanded_last_only() {
    let rig = OperatedPlant::new();
    let alice = operator("alice", "alice#1");
    let drive = rig.plant.drive("p1").unwrap();
    assert!(renew(&drive, &alice, rig.now).unwrap_err().contains("no `supervision`"));
    assert_eq!(drive.commander(), None);
    let _placed = rig.take(&alice, "p1", "{\"speed_reference\": 10}");
    assert_eq!(drive.commander().as_deref(), Some("alice#1"));
    let Progress::Placed(mut refused) = rig.take(&operator("bob", "bob#2"), "p1", "{\"speed_reference\": 1000}") else {
        panic!("its limits are those of the order");
    };
    assert_eq!(refused.placed.answer().unwrap().outcome.code(), "bad_value");
    assert_eq!(
        drive.commander().as_deref(),
        Some("alice#1"),
        "what is refused commands nothing"
    );
    let origin = Origin::new(SourceKind::Mqtt, "t");
    let points = vec![(
        drive.image.spec.profile.point_index("run").unwrap(),
        drivegate_model::drive::Value::Bool(false),
    )];
    let _placed = drive.place(
        OrderRequest::new(
            drivegate_core::order::Order::Points(points),
            origin,
            drivegate_core::order::Authority::Write,
        )
        .within(Duration::from_secs(1)),
        rig.now,
    );
    assert_eq!(drive.commander(), None, "another client");
}

#[test]
fn a_stop_is_carried_out_whatever_becomes_of_the_rest() {
    use drivegate_core::order::Urgency;
    let rig = OperatedPlant::new();
    let alice = operator("alice", "alice#1");
    let bodies = [
        "{\"run\": false, \"speed_reference\": 1000}",
        "{\"run\": false, \"sped\": 1}",
        "{\"id\": 7, \"run\": false, \"speed_reference\": 5}",
        "{\"id\": 7, \"run\": false, \"speed_reference\": 5}",
    ];
    for (body, rest) in bodies.into_iter().zip(["bad_value", "not_writable", "", "not_allowed"]) {
        let Progress::Placed(mut waiting) = rig.take(&alice, "p1", body) else {
            panic!("{body}");
        };
        while let Some(command) = next_command(&mut rig.plant.buses[0].queue.lock(), Urgency::Read, rig.now) {
            command.answer(&Outcome::Acknowledged(drivegate_proto::Reply::Written), rig.now);
        }
        let answer = waiting.placed.answer().unwrap();
        let code = match &answer.outcome {
            Outcome::StopOnly(rest) => rest.code(),
            Outcome::Acknowledged(_) => "",
            other => panic!("{body}: {other:?}"),
        };
        assert_eq!(code, rest, "{body}");
        let expected = match rest {
            "" => StatusCode::OK,
            "not_allowed" => StatusCode::FORBIDDEN,
            _ => StatusCode::UNPROCESSABLE_ENTITY,
        };
        assert_eq!(status(&answer.outcome), expected, "{body}");
    }
}

#[test]
fn a_start_whose_body_comes_late_does_not_run_behind_a_stop() {
    let mut rig = OperatedPlant::new();
    let (alice, time) = (operator("alice", "alice#1"), SystemTime::UNIX_EPOCH);
    let asked = rig.now;
    rig.now += Duration::from_millis(20);
    let _stop = rig.take(&operator("bob", "bob#2"), "p1", "{\"run\": false}");
    rig.now += Duration::from_millis(30);
    let times = (Arrival::now(asked), rig.now, time);
    let outcome = |progress: Progress| match progress {
        Progress::Placed(mut waiting) => waiting.placed.answer().map(|answer| answer.outcome),
        _ => panic!("not placed"),
    };
    let start = b"{\"run\": true}";
    let late = rig.operating.take(&rig.plant, &alice, "p1", start, times.clone());
    assert_eq!(outcome(late), Some(Outcome::Purged));
    assert_eq!(status(&Outcome::Purged), StatusCode::CONFLICT);
    let other = rig.operating.take(&rig.plant, &alice, "p2", start, times);
    assert_eq!(outcome(other), None, "nobody stopped that drive");
    assert_eq!(
        outcome(rig.take(&alice, "p1", "{\"run\": true}")),
        None,
        "asked for since"
    );
}
