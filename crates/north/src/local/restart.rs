//! Restart of a drive's communication by function 08, subfunction 01: the only request that ends its Listen Only Mode, in which it
//! answers nothing, this one included [C 7.1.7].

use std::future::poll_fn;
use std::time::{Duration, Instant};

use super::protocol::WriteOutcome;
use crate::codec::RequestPdu;
use crate::command::{Answer, DEFAULT_EXPIRY, Origin, Outcome, Refusal};
use crate::drive::RESTART_COMMUNICATION;
use crate::plant::{DriveHandle, Question, Shown, Target};
use crate::process_image::Access;

/// Until the drive is polled again and answers: the longest pause between two probes, and some.
const BACK: Duration = Duration::from_secs(12);
const LOOK: Duration = Duration::from_millis(50);

/// Sends it, and waits until the drive answers again. Nothing is told as done that was not seen.
pub(super) async fn communication(drive: &DriveHandle, origin: Origin, asked: Instant) -> WriteOutcome {
    let (spec, now) = (&drive.image.spec, Instant::now());
    if spec.access != Access::Control {
        let refusal = Refusal::NotAllowed(format!(
            "drive `{}` takes no commands; set access = \"control\"",
            spec.name
        ));
        return WriteOutcome::new(
            &drive.refuse(RESTART_COMMUNICATION, refusal, origin, now),
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
        asked,
        expires: now + DEFAULT_EXPIRY,
        origin,
    };
    let mut exchange = drive.ask_line(question, now);
    let (outcome, _) = poll_fn(|cx| exchange.poll(cx)).await;
    let sent = Instant::now();
    let answer = |outcome: Outcome| Answer {
        outcome,
        latency: sent.saturating_duration_since(now),
    };
    let mut told = WriteOutcome::new(&answer(outcome), Shown::default());
    let answers = || drive.image.snapshot().fast_at.is_some_and(|at| at > sent);
    while !answers() && sent.elapsed() < BACK {
        tokio::time::sleep(LOOK).await;
    }
    // In Listen Only Mode the drive does not answer the request that ends it.
    if told.result == "timeout" && answers() {
        let millis = |time: Duration| (time.as_secs_f64() * 1e6).round() / 1e3;
        told.ok = true;
        told.result = crate::command::CONFIRMED.to_string();
        told.confirmed_ms = Some(millis(now.elapsed()));
        told.message = "sent; the drive answers again".to_string();
    } else if !told.ok {
        told.message += "; the drive does not answer: check its supply, the wiring and its address";
    }
    told
}
