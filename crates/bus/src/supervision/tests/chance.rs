//! Whatever a client does at whatever time: the action is written when the client goes silent, and only then.

use drivegate_testkit::next_command;
use proptest::prelude::*;

use super::*;

#[derive(Debug, Clone, Copy)]
enum Event {
    Nothing,
    Heartbeat,
    /// A reference of a client is queued.
    Order,
    /// The waiting command starts, or the next step of the started one is sent.
    Send,
    /// The started command ends, acknowledged or not.
    End(bool),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        4 => Just(Event::Nothing),
        1 => Just(Event::Heartbeat),
        2 => Just(Event::Order),
        2 => Just(Event::Send),
        2 => any::<bool>().prop_map(Event::End),
    ]
}

/// Actions of the client, as a model of one line.
#[derive(Default)]
struct Client {
    /// When the client was last known to be alive.
    heard: Option<Instant>,
    /// Whether the action was acknowledged since.
    acted: bool,
    /// Until when the waiting and the started command keep the lease alive, and whether the started one is on the wire.
    queued: Option<Instant>,
    begun: Option<(Instant, bool)>,
}

impl Client {
    fn heard(&mut self, now: Instant) {
        (self.heard, self.acted) = (Some(now), false);
    }

    fn acts(&mut self, rig: &mut SupervisedDrive, event: Event) {
        let now = rig.now;
        self.queued = self.queued.filter(|until| *until > now);
        match (event, self.queued, self.begun) {
            (Event::Heartbeat, ..) => {
                rig.heartbeat();
                self.heard(now);
            }
            (Event::Order, ..) => {
                drop(rig.order());
                self.queued = Some(now + DEFAULT_EXPIRY);
            }
            (Event::Send, _, Some((until, false))) if until > now => {
                rig.send();
                self.begun = Some((until, true));
                self.heard(now);
            }
            (Event::Send, Some(until), None) => {
                rig.begin();
                (self.queued, self.begun) = (None, Some((until, false)));
            }
            (Event::End(ok), _, Some((_, sent))) => {
                rig.end(if ok && sent {
                    &Outcome::TimedOut
                } else {
                    &Outcome::Expired
                });
                self.begun = None;
                if sent {
                    self.heard(now);
                }
            }
            _ => {}
        }
    }

    fn is_silent(&self, now: Instant) -> bool {
        let holds = self
            .queued
            .max(self.begun.map(|(until, _)| until))
            .is_some_and(|until| until > now);
        let late = self.heard.is_some_and(|at| now - at >= Duration::from_secs(5));
        late && !holds && !self.acted
    }
}

proptest! {
    #[test]
    fn the_action_comes_when_the_client_falls_silent_and_only_then(
        events in proptest::collection::vec((1u64..1500, event()), 1..200),
    ) {
        let mut rig = SupervisedDrive::new(LeaseAction::Stop);
        let mut client = Client::default();
        for (ms, event) in events {
            rig.now += Duration::from_millis(ms);
            client.acts(&mut rig, event);
            let due = client.is_silent(rig.now);
            rig.look(0, true);
            let action = next_command(&mut rig.bus.queue.lock(), Urgency::Stop, rig.now);
            prop_assert_eq!(action.is_some(), due, "{:?}", event);
            if let Some(action) = action {
                action.answer(&acknowledged(), rig.now);
                rig.look(0, true);
                client.acted = true;
            }
        }
    }
}
