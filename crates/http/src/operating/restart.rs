//! Restart of a drive's communication by function 08, subfunction 01: the only request that ends Listen Only Mode,
//! in which the drive answers no request, not even this one [C 7.1.7].

use std::future::poll_fn;
use std::time::{Duration, Instant};

use drivegate_core::order::{Answer, Arrival, DEFAULT_EXPIRY, Origin, Outcome, Refusal};
use drivegate_core::plant::{DriveHandle, Question, Shown, Target};
use drivegate_core::process_image::Access;
use drivegate_model::drive::RESTART_COMMUNICATION;
use drivegate_proto::{Reply, RequestPdu};

/// Time within which the drive must be polled again and answer: somewhat longer than the longest pause between two probes.
const BACK: Duration = Duration::from_secs(12);
const LOOK: Duration = Duration::from_millis(50);

/// The message for a silent drive.
const NO_ANSWER: &str = "the drive does not reply: check its power supply, wiring and address";

/// Sends the restart and waits until the drive replies again. Success is reported only if a reply was observed.
pub(super) async fn communication(drive: &DriveHandle, origin: Origin, arrival: Arrival) -> (Answer, Shown) {
    let (spec, now) = (&drive.image.spec, Instant::now());
    if spec.access != Access::Control {
        let refusal = Refusal::NotAllowed(format!(
            "drive `{}` accepts no commands; set access = \"control\"",
            spec.name
        ));
        return (
            drive.refuse(RESTART_COMMUNICATION, refusal, origin, now),
            Shown::default(),
        );
    }
    if let Err(refusal) = drive.is_meant(origin.kind, &arrival) {
        return (
            drive.refuse(RESTART_COMMUNICATION, refusal, origin, now),
            Shown::default(),
        );
    }
    let question = Question {
        target: Target::Address(spec.address),
        pdu: RequestPdu::Diagnostics {
            subfunction: 1,
            data: 0,
        },
        may_write: true,
        expires: arrival.asked + DEFAULT_EXPIRY,
        arrival,
        origin,
    };
    let mut exchange = drive.ask_line(question, now);
    let (outcome, _) = poll_fn(|cx| exchange.poll(cx)).await;
    let sent = Instant::now();
    let answers = || drive.image.snapshot().fast_at.is_some_and(|at| at > sent);
    while !answers() && sent.elapsed() < BACK {
        tokio::time::sleep(LOOK).await;
    }
    let latency = sent.saturating_duration_since(now);
    // In Listen Only Mode the drive does not even answer the request that ends this mode.
    if outcome == Outcome::TimedOut && answers() {
        let shown = Shown {
            after: Some(now.elapsed()),
            unseen: None,
        };
        let outcome = Outcome::Acknowledged(Reply::Written);
        return (Answer { outcome, latency }, shown);
    }
    let shown = Shown {
        after: None,
        unseen: (!outcome.is_ok()).then(|| NO_ANSWER.to_string()),
    };
    (Answer { outcome, latency }, shown)
}
