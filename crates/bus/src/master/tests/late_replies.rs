//! Late replies: requests whose replies could be confused wait.

use super::super::timing::N2_LATE;
use super::*;
use crate::late_replies::FORGOTTEN_AFTER;

#[test]
fn an_n2_stop_whose_answer_may_be_a_late_one_is_sent_again_when_none_can_come() {
    let mut rig = Rig::of(2, "vacon-nx-n2", Protocol::N2);
    let writes = |rig: &Rig, of: usize| -> Vec<Instant> {
        let of = |(_, turn): &&(Instant, Turn)| turn.drive().is_some_and(|drive| drive == of) && turn.pdu().is_write();
        rig.wire.iter().filter(of).map(|(at, _)| *at).collect()
    };
    rig.drives[1].next_write = Some(Ended::Silent);
    let _run = rig.switch(1, "a", true);
    while writes(&rig, 1).is_empty() {
        rig.step();
    }
    let given_up = rig.now;
    rig.drives[0].next_write = Some(Ended::Corrupt(MAY_BE_LATE));
    let mut stop = rig.switch(0, "a", false);
    rig.run(Duration::from_secs(1));
    let sent = writes(&rig, 0);
    assert_eq!(sent.len(), 2);
    assert!(sent[0] < given_up + COST * 2, "it waits for nobody");
    // A drive answers in order: once each has answered another request, no late reply can arrive.
    let asked = |of: usize| {
        let between = |at: &Instant| *at > sent[0] && *at < sent[1];
        rig.wire
            .iter()
            .any(|(at, turn)| turn.drive().is_some_and(|drive| drive == of) && between(at))
    };
    assert!(asked(0) && asked(1));
    assert!(sent[1] < sent[0] + rig.master.response_timeout * N2_LATE);
    assert!(outcome(&mut stop).is_some_and(|o| o.is_ok()));
}

/// A reply that an adapter or a repeater sends twice may arrive damaged first and intact afterwards.
#[test]
fn a_mangled_reply_may_come_once_more_where_one_that_never_came_may_not() {
    for (mangled, expected) in [(true, true), (false, false)] {
        let mut rig = Rig::of(2, "vacon-nx-n2", Protocol::N2);
        let read = |rig: &mut Rig| loop {
            let next = rig.master.next(rig.now, &mut Vec::new());
            match next {
                Err(until) => rig.now = until,
                Ok(turn) if matches!(turn.pdu(), RequestPdu::Read { .. }) => break turn,
                Ok(turn) => panic!("{turn:?}"),
            }
        };
        let end = |ended| TurnEnd {
            ended,
            began: rig.now,
            at: rig.now,
            stood: false,
            took: COST,
            mangled,
            doubted: false,
            frame: Vec::new(),
        };
        let garbled = end(Ended::Corrupt("checksum"));
        let mut turn = read(&mut rig);
        // The reply before has another form than this one's.
        let written = RequestPdu::WriteCoil { address: 0, on: true };
        rig.master.last_answered = [Some((turn.target(), written)), None];
        assert!(!rig.master.sending(&turn, rig.now).could_be_doubled);
        rig.now += COST;
        rig.master.done(&turn, garbled, rig.now, &mut Vec::new());
        if let Purpose::Poll(poll) = &mut turn.purpose {
            poll.drive = DriveIndex::new(1 - poll.drive.place());
        }
        assert_eq!(rig.master.sending(&turn, rig.now).could_be_doubled, expected);
    }
}

#[test]
fn a_duplicate_of_the_reply_before_the_last_one_may_come() {
    let mut rig = Rig::new(1);
    let turn = loop {
        match rig.master.next(rig.now, &mut Vec::new()) {
            Ok(turn) => break turn,
            Err(until) => rig.now = until,
        }
    };
    let other = Turn {
        pdu: RequestPdu::WriteCoil { address: 0, on: true },
        ..turn.clone()
    };
    let mut may_be_doubled = |answered: &Turn| {
        rig.master.note_answered(answered);
        rig.master.sending(&turn, rig.now).could_be_doubled
    };
    assert!(may_be_doubled(&turn));
    assert!(
        may_be_doubled(&other),
        "a long reply takes longer than a short transaction"
    );
    assert!(!may_be_doubled(&other));
}

#[test]
fn a_reply_to_a_broken_off_exchange_is_waited_for_by_the_bus_that_comes_after() {
    for protocol in [(Protocol::ModbusRtu, "vacon-nx"), (Protocol::N2, "vacon-nx-n2")] {
        let mut rig = Rig::of(1, protocol.1, protocol.0);
        let (now, deadline) = (rig.now, rig.now + Duration::from_secs(4));
        let quiet = |handover: Handover| handover.quiet_until.unwrap();
        let left = quiet(rig.master.ended(Some(deadline), now));
        let window = match protocol.0 {
            Protocol::N2 => N2_LATE * rig.master.response_timeout,
            _ => FORGOTTEN_AFTER,
        };
        assert_eq!(left, deadline + window);
    }
    let mut rig = Rig::new(1);
    assert_eq!(rig.master.ended(None, rig.now).quiet_until, Some(rig.now));
}

/// The end of a turn without an accepted reply.
fn no_reply(rig: &mut Rig, doubted: bool) -> TurnEnd {
    let began = rig.now;
    rig.now += TIMEOUT;
    TurnEnd {
        ended: Ended::Silent,
        began,
        at: rig.now,
        stood: false,
        took: TIMEOUT,
        mangled: false,
        doubted,
        frame: Vec::new(),
    }
}

/// Sends the next request and ends it without an accepted reply.
fn fail(rig: &mut Rig, doubted: bool) {
    let turn = loop {
        match rig.master.next(rig.now, &mut Vec::new()) {
            Err(until) => rig.now = until,
            Ok(turn) => break turn,
        }
    };
    rig.master.sending(&turn, rig.now);
    let end = no_reply(rig, doubted);
    let mut news = Vec::new();
    rig.master.done(&turn, end, rig.now, &mut news);
    rig.news.append(&mut news);
}

/// The reply of a drive that was just switched on may be too early for the configured baud rate: the request is
/// repeated at once, not after the pause between two probes.
#[test]
fn a_probe_whose_reply_was_not_believed_is_repeated_at_once() {
    for (doubted, soon) in [(true, true), (false, false)] {
        let mut rig = Rig::new(1);
        rig.drives[0].silent = true;
        rig.run(Duration::from_secs(60));
        fail(&mut rig, doubted);
        assert_eq!(rig.master.next(rig.now, &mut Vec::new()).is_ok(), soon);
    }
}

/// Replies that arrive sooner than the baud rate allows do not make a drive offline while they are not accepted
/// yet; silence does.
#[test]
fn replies_that_are_not_believed_take_no_drive_away() {
    for (doubted, gone) in [(true, false), (false, true)] {
        let mut rig = Rig::new(1);
        rig.run(Duration::from_secs(2));
        rig.news.clear();
        (0..4).for_each(|_| fail(&mut rig, doubted));
        let offline = rig.news.contains(&News::Offline(DriveIndex::new(0)));
        assert_eq!(offline, gone);
    }
}
