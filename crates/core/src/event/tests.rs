//! Tests of the kept events and of who receives them.

use std::time::Duration;

use super::*;

fn event(text: String) -> Event {
    Event {
        bus: "line1".to_string(),
        ..Event::new(EventKind::Offline, SystemTime::UNIX_EPOCH, text)
    }
}

/// A new kind does not compile until it is here, and then in `ALL`.
#[test]
fn all_kinds_are_listed() {
    use EventKind::*;
    for (place, kind) in EventKind::ALL.into_iter().enumerate() {
        let last = match kind {
            Online | Offline | Fault | FaultEnd | Started | Stopped | Warning | WarningEnd | ControlPlace
            | Restarted | UnlikeProfile | SelectionDiffers | Supervision | SupervisionFailed | Unsupervised
            | RefusedCommand | NotConfirmed | BusUp | BusDown | Recording | ReloadRefused | ForeignCommand => false,
            ParametersChanged | RestoreUnfinished | Diagnosis | Guarded | Interlock | Held | Released | HoldBroken
            | Drill => false,
            Paused => false,
            SlotVoid => true,
        };
        assert_eq!(kind as usize, place);
        assert_eq!(last, place + 1 == EventKind::ALL.len());
    }
}

#[test]
fn a_burst_of_all_drives_reaches_who_is_busy_and_who_comes_late() {
    for (drives, burst) in [(4, 4096), (300, 4800), (1_000_000, BURST)] {
        let events = Events::of_drives(drives);
        let mut busy = events.subscribe();
        (0..burst).for_each(|n| events.publish(event(n.to_string())));
        let heard = std::iter::from_fn(|| busy.try_recv().ok());
        assert!(heard.map(|e| e.id).eq(1..=burst as u64), "{drives} drives");
        let kept = events.recent();
        assert_eq!(kept.len(), KEPT);
        assert_eq!(kept.last().map(|e| e.id), Some(burst as u64));
    }
}

#[test]
fn refusals_push_out_no_event_of_a_drive_and_a_drive_none_of_another() {
    let (events, start) = (Events::default(), Instant::now());
    let fault = |drive: &str, kind| Event {
        kind,
        drive: Some(drive.to_string()),
        ..event("F1".to_string())
    };
    events.publish(fault("pump-1", EventKind::Fault));
    let client = |n: u32| Arc::from(format!("modbus_tcp 10.0.0.{}", n % 64));
    for n in 0..100_000 {
        let refused = RefusedCommand {
            client: &client(n),
            reason: "not_allowed",
            kind: EventKind::RefusedCommand,
            bus: "line1",
            drive: "pump-1",
            text: "refused".to_string(),
        };
        events.publish_refusal(refused, start + Duration::from_millis(n.into()));
    }
    events.publish_due(start + Duration::from_secs(200));
    let refused: Vec<_> = events
        .recent()
        .into_iter()
        .filter(|e| e.kind == EventKind::RefusedCommand)
        .collect();
    assert_eq!(refused.len(), REFUSALS_KEPT);
    assert!(
        refused
            .last()
            .unwrap()
            .text
            .contains("commands of this client were refused)")
    );
    (0..2 * KEPT).for_each(|_| events.publish(fault("pump-2", EventKind::Online)));
    (0..2 * KEPT).for_each(|_| events.publish(fault("pump-2", EventKind::Fault)));
    let kept = events.recent();
    assert_eq!(kept.len(), KEPT + REFUSALS_KEPT);
    assert_eq!((kept[0].id, kept[0].drive.as_deref()), (1, Some("pump-1")));
    assert!(kept.is_sorted_by_key(|event| event.id));
}
