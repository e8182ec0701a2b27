//! Exceptions of a drive, or of a gateway in between: which of them refuse an order, and which are followed by another try.

use super::*;

/// The outcome of an order if the first drive answers its first `times` writes with this exception, and the number
/// of writes.
fn excepted(run: bool, times: u32, exception: Exception) -> (Outcome, usize) {
    let mut rig = Rig::new(2);
    rig.drives[0].holding.insert(2000, u16::from(!run));
    rig.run(Duration::from_secs(1));
    let mut answer = rig.switch(0, "client", run);
    rig.drives[0].to_writes = Some((times, exception));
    let (from, end) = (rig.wire.len(), rig.now + 2 * DEFAULT_EXPIRY);
    let outcome = loop {
        rig.step();
        if let Some(outcome) = outcome(&mut answer) {
            break outcome;
        }
        assert!(rig.now < end, "{exception}: no answer");
    };
    let writes = rig.wire[from..].iter().filter(|(_, turn)| turn.pdu().is_write());
    (outcome, writes.count())
}

#[test]
fn exceptions_that_refuse_nothing_end_no_command_as_refused() {
    for run in [true, false] {
        let (outcome, writes) = excepted(run, 3, Exception::BUSY);
        assert_eq!((outcome.is_ok(), writes), (true, 4), "run={run}");
        let (outcome, writes) = excepted(run, u32::MAX, Exception::BUSY);
        assert_eq!(outcome, Outcome::Exception(Exception::BUSY));
        assert!(writes >= 5, "{writes}");
        for open in [
            Exception::ACKNOWLEDGE,
            Exception::GATEWAY_PATH,
            Exception::GATEWAY_TARGET,
        ] {
            assert!(excepted(run, 1, open).0.is_ok(), "{open}: it is tried again");
            let (outcome, writes) = excepted(run, u32::MAX, open);
            assert_eq!((outcome.code(), writes), ("unknown", 2), "{open}");
            assert!(outcome.to_string().contains("unknown"), "{outcome}");
            assert_eq!(outcome.exception(), Some(open));
        }
        // A maker's own codes, which have the numbers that errors of N2 have for clients.
        let refused = [0x01, 0x02, 0x03, 0x04, 0x07, 0x08, 0x22, 0x80, 0x81, 0x90, 0xFF].map(Exception::Modbus);
        for refused in refused {
            // For a drive that does not know function 06, the write is repeated with function 16.
            let writes = if refused == Exception::FUNCTION { 2 } else { 1 };
            assert_eq!(excepted(run, u32::MAX, refused), (Outcome::Exception(refused), writes));
        }
    }
}

#[test]
fn a_client_that_is_back_suspends_a_stop_of_its_lease_that_the_drive_was_too_busy_for() {
    let mut rig = Rig::new(1);
    let mut run = rig.switch(0, "client", true);
    rig.run(Duration::from_millis(100));
    assert!(outcome(&mut run).is_some_and(|o| o.is_ok()));
    rig.drives[0].to_writes = Some((u32::MAX, Exception::BUSY));
    rig.run(Duration::from_millis(1000));
    rig.drives[0].to_writes = None;
    rig.bus.image.drives[0].renew_lease(rig.now);
    rig.run(Duration::from_millis(400));
    assert!(rig.runs(0), "the drive never took it, and its client is back");
}

#[test]
fn what_a_gateway_in_between_answers_is_no_sign_of_the_drive() {
    for exception in [Exception::GATEWAY_PATH, Exception::GATEWAY_TARGET] {
        let mut rig = Rig::new(2);
        rig.drives[0].to_reads = Some(exception);
        rig.run(Duration::from_secs(1));
        assert!(rig.news.contains(&News::Offline(DriveIndex::new(0))), "{exception}");
        assert!(!rig.master.schedule.is_online(DriveIndex::new(0)), "{exception}");
        assert!(rig.master.schedule.is_online(DriveIndex::new(1)));
        rig.drives[0].to_reads = None;
        rig.run(Duration::from_secs(3));
        assert!(
            rig.master.schedule.is_online(DriveIndex::new(0)),
            "{exception}: it is back"
        );
    }
    // Any other exception shows that the drive is present, and only one about the request itself splits the read.
    for code in (1..=9).chain([0x80, 0x81, 0x90]).map(Exception::Modbus) {
        let mut rig = Rig::new(1);
        rig.drives[0].to_reads = Some(code);
        rig.news.clear();
        rig.run(Duration::from_secs(3));
        assert!(rig.master.schedule.is_online(DriveIndex::new(0)), "{code}");
        let unavailable = rig.news.iter().any(|news| matches!(news, News::Unavailable(..)));
        assert_eq!(unavailable, matches!(code.code(), 1..=3), "{code}");
    }
}

#[test]
fn a_slow_request_that_the_drive_is_too_busy_for_is_not_repeated_at_once() {
    let mut rig = Rig::new(1);
    rig.drives[0].to_reads = Some(Exception::BUSY);
    rig.run(Duration::from_secs(2));
    let (from, begin) = (rig.wire.len(), rig.now);
    rig.run(Duration::from_secs(10));
    let slow = |(_, turn): &&(Instant, Turn)| matches!(&turn.purpose, Purpose::Poll(poll) if poll.read.class == PollClass::Slow);
    let items = rig.bus.image.drives[0].plan.reads.iter();
    let items = items.filter(|read| read.class == PollClass::Slow).count();
    let asked = rig.wire[from..].iter().filter(slow).count();
    assert!(asked <= items * 11, "{asked} of {items} in {:?}", rig.now - begin);
}
