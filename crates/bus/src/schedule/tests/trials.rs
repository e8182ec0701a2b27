//! Reads of bits that no manual states: tried, proved, or left.

use std::time::Duration;

use drivegate_testkit::profile;

use super::super::*;
use drivegate_model::drive::DriveIndex;
use drivegate_proto::Table;

/// Reaction of a drive to a read of several bits.
#[derive(Clone, Copy, PartialEq)]
enum Does {
    Answers,
    Refuses,
    KeepsSilent,
}

/// The reads of a CX in the last second of half a minute, and how often it went offline.
fn half_a_minute(does: Does) -> (Vec<u16>, u32) {
    let cx = profile("vacon-cx");
    let plan = Plan::of(&cx);
    let cadence = Cadence {
        fast: Duration::from_millis(200),
        slow: Duration::from_secs(6),
        retries: 1,
    };
    let cost = Duration::from_millis(20);
    let begin = Instant::now();
    let mut now = begin;
    let mut schedule = Schedule::new(cadence, &[&plan], |_, _| cost, now);
    let (mut bits, mut gone) = (Vec::new(), 0);
    while now < begin + Duration::from_secs(30) {
        match schedule.next(now, None) {
            Decision::Idle(until) => now = until.max(now + Duration::from_millis(1)),
            Decision::Command(_) => unreachable!(),
            Decision::Poll(poll) => {
                now += cost;
                let many = poll.read.table == Table::DiscreteInput && poll.read.count > 1;
                let polled = match (many, does) {
                    (true, Does::Refuses) => Polled::Refused(Exception::VALUE),
                    (true, Does::KeepsSilent) => Polled::Failed,
                    _ => Polled::Ok,
                };
                if many && does == Does::Answers {
                    schedule.proved(DriveIndex::new(0), &poll.read);
                }
                gone += u32::from(schedule.poll_done(&poll, polled, cost, now) == Change::Offline);
                if poll.read.table == Table::DiscreteInput && now > begin + Duration::from_secs(29) {
                    bits.push(poll.read.count);
                }
            }
        }
    }
    (bits, gone)
}

#[test]
fn a_drive_that_answers_it_is_read_by_one_request() {
    let (bits, gone) = half_a_minute(Does::Answers);
    assert!(!bits.is_empty() && bits.iter().all(|count| *count == 5), "{bits:?}");
    assert_eq!(gone, 0);
}

#[test]
fn a_drive_that_does_not_is_read_singly_and_never_away() {
    for does in [Does::Refuses, Does::KeepsSilent] {
        let (bits, gone) = half_a_minute(does);
        assert!(bits.iter().filter(|count| **count == 1).count() >= 5, "{bits:?}");
        assert_eq!(gone, 0);
    }
}
