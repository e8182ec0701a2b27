//! The hold of a drive, as the servers use it.

use std::time::{Instant, SystemTime};

use super::{BusHandle, DriveHandle, Plant};
use crate::event::{Event, EventKind, Events};
use crate::order::{Arrival, Asks, Authority, Command, Origin, Refusal};
use crate::permit::{
    self, Claim, HoldChange, HoldState, HoldView, KeptReservation, Rules, Stage, Unheld, Verb, What, client_access,
};
use drivegate_model::drive::DriveIndex;
use drivegate_model::drive::why::{Cause, Explanation};

impl BusHandle {
    /// Whether a command of that client renews the lease of a drive.
    pub fn renews(&self, drive: DriveIndex, origin: &Origin) -> bool {
        !self.queue.has_authority() || self.queue.lock().gate.hold_renews(drive, origin)
    }

    /// Publishes the changes of the holds of its drives.
    pub fn publish_holds(&self, events: &Events, now: Instant, time: SystemTime) {
        if !self.queue.has_authority() {
            return;
        }
        let mut queue = self.queue.lock();
        let told = queue.gate.take_changes(now);
        let unheld = queue.gate.take_unheld();
        let rules = queue.gate.rules().cloned();
        drop(queue);
        let Some(rules) = rules else { return };
        let name_of = |drive: DriveIndex| self.image.drives.get(drive).map(|image| image.spec.name.as_str());
        for (drive, Unheld { client, why }) in unheld {
            tracing::warn!(
                target: "drivegate::command", drive = name_of(drive),
                "carried out a command from {client} that `mode = \"exclusive\"` would refuse: {why}; logged once per \
                 client and minute"
            );
        }
        for (drive, told) in told {
            let Some(image) = self.image.drives.get(drive) else {
                continue;
            };
            let (kind, text) = event_text(&told, &rules);
            events.publish(Event {
                bus: self.image.spec.name.clone(),
                drive: Some(image.spec.name.clone()),
                ..Event::new(kind, time, text)
            });
            // An update of the image makes the interfaces show the hold again.
            image.update(|_| {});
        }
    }

    /// After a reload: ends the holds of machines that are on none of these buses, and publishes the ends.
    pub fn end_holds(&self, after: &[&BusHandle], events: &Events, now: Instant, time: SystemTime) {
        if !self.queue.has_authority() {
            return;
        }
        for (index, drive) in self.image.drives.enumerate() {
            let machine = self.image.spec.machine(&drive.spec);
            let is_there = |bus: &&BusHandle| {
                let mut drives = bus.image.drives.iter();
                drives.any(|drive| bus.image.spec.machine(&drive.spec) == machine)
            };
            if !after.iter().any(is_there) {
                let why = "a reload changed bus, address or profile of the drive";
                self.queue.lock().gate.hold_ends(index, why);
            }
        }
        self.publish_holds(events, now, time);
    }

    /// Whether a command that is about to be sent renews the lease of its drive.
    pub fn renews_by(&self, command: &Command) -> bool {
        if !self.queue.has_authority() {
            return true;
        }
        let queue = self.queue.lock();
        let mut origins = command.origins();
        let renews = |drive| origins.any(|origin| queue.gate.hold_renews(drive, origin));
        command.drive().is_some_and(renews)
    }
}

impl BusHandle {
    fn reservations(&self, now: Instant, time: SystemTime) -> Vec<(Instant, KeptReservation)> {
        let queue = self.queue.lock();
        let drives = self.image.drives.enumerate();
        let kept = drives.filter_map(|(index, image)| {
            let (until, who, rank, lease) = queue.gate.reservation(index, now)?;
            let machine = self.image.spec.machine(&image.spec);
            let stopped = time.checked_sub(lease.saturating_sub(until.saturating_duration_since(now)))?;
            Some((until, KeptReservation::new(machine, (who, rank), stopped, lease)))
        });
        kept.collect()
    }
}

impl DriveHandle {
    /// Whether `[authority]` is on.
    pub fn has_authority(&self) -> bool {
        self.bus.queue.has_authority()
    }

    /// Applies a client's action, which arrived so, to the hold and returns its published state. A refusal is audited, counted and
    /// published like that of a command.
    ///
    /// # Errors
    /// If the hold refuses the action; contains the refusal.
    pub fn hold(
        &self,
        verb: Verb,
        origin: &Origin,
        authority: Authority,
        (arrival, now): (&Arrival, Instant),
    ) -> Result<HoldView, Refusal> {
        let acted = self.is_meant(origin.kind, arrival);
        match acted.and_then(|()| self.act(verb, origin, authority, now)) {
            Ok(view) => Ok(view),
            Err(refusal) => {
                self.refuse(&format!("hold={}", verb.name()), refusal.clone(), origin.clone(), now);
                Err(refusal)
            }
        }
    }

    fn act(&self, verb: Verb, origin: &Origin, authority: Authority, now: Instant) -> Result<HoldView, Refusal> {
        permit::authority(&self.reading(now), authority)?;
        client_access(Stage::Accept, false, origin, &self.image.spec.bus)?;
        if let (Some(why), Verb::Take | Verb::Break) = (self.image.restore_lock.reason(), verb) {
            return Err(Refusal::NotAllowed(why.to_string()));
        }
        let mut queue = self.bus.queue.lock();
        let acted = queue.gate.hold_act(self.index, origin, verb, now).unwrap_or_else(|| {
            Err(Refusal::NotAllowed(
                "drives cannot be held: [authority] is off; set its mode".to_string(),
            ))
        });
        let view = queue.gate.hold_view(self.index, None, now);
        drop(queue);
        // The waiting order of a former holder may have to end, so the bus is woken.
        self.bus.queue.wake();
        acted?;
        if verb != Verb::Release {
            self.image.renew_lease(now);
        }
        view.map(|(view, _)| view)
            .ok_or_else(|| Refusal::NotAllowed("[authority] was turned off".to_string()))
    }

    /// The published state of the hold, and whether this client has the hold; `None` while `[authority]` is off.
    pub fn hold_view(&self, origin: Option<&Origin>, now: Instant) -> Option<(HoldView, bool)> {
        if self.bus.queue.has_authority() {
            self.bus.queue.lock().gate.hold_view(self.index, origin, now)
        } else {
            None
        }
    }

    /// The client's name as a principal, and the ranks below its own; `None` if the client is not a principal.
    pub fn rank_of(&self, origin: &Origin) -> Option<(String, Vec<String>)> {
        let rules = if self.bus.queue.has_authority() {
            self.bus.queue.lock().gate.rules().cloned()?
        } else {
            return None;
        };
        let claim = rules.claim_of(origin)?;
        let below = rules.ranks.iter().skip(claim.rank + 1).map(ToString::to_string);
        Some((claim.name.to_string(), below.collect()))
    }

    /// Processes the heartbeat of a client that may command: renews the lease of the drive, unless another client's
    /// silence counts, and the client's hold.
    pub fn heartbeat(&self, origin: &Origin, now: Instant) {
        if !self.bus.queue.has_authority() {
            return self.image.renew_lease(now);
        }
        let mut queue = self.bus.queue.lock();
        queue.gate.hold_renewed(self.index, origin, now);
        let renews = queue.gate.hold_renews(self.index, origin);
        drop(queue);
        if renews {
            self.image.renew_lease(now);
        }
    }

    /// Adds a reservation after a stop to the explanation.
    pub(super) fn with_reservation(&self, mut why: Explanation, now: Instant) -> Explanation {
        let view = self.hold_view(None, now).map(|(view, _)| view);
        let Some(view) = view.filter(|view| view.state == HoldState::Reserved && why.runs == Some(false)) else {
            return why;
        };
        let (who, rank) = (view.holder.unwrap_or_default(), view.rank.unwrap_or_default());
        let left = view.left_s.unwrap_or_default();
        let mut evidence = format!("{who} ({rank}) stopped it; reserved for another {left} s");
        let mut remedy = format!("wait, or have {who} release it; ranks from {rank} up may take it");
        if let Some(repeater) = self.bus.queue.lock().gate.repeater(self.index) {
            evidence += &format!("; {repeater} repeats its stop, which ended the hold of another client");
            remedy = format!(
                "set cyclic = true for principal `{repeater}` if it writes its command word cyclically; else {remedy}"
            );
        }
        why.causes.push(Cause {
            cause: HoldState::Reserved.name().to_string(),
            evidence,
            remedy,
            ..Cause::default()
        });
        why
    }

    /// Notes that a client withdrew its run command although nothing is sent for it.
    pub fn said_stop(&self, origin: &Origin) {
        self.bus.queue.lock().gate.hold_said_stop(self.index, origin);
    }

    /// Whether this client may start a restore of parameters; judged once at the start, so that no restore is left
    /// half done.
    ///
    /// # Errors
    /// If the client may not restore; contains the refusal.
    pub fn may_begin_restore(&self, origin: &Origin, now: Instant) -> Result<(), Refusal> {
        let queue = self.bus.queue.lock();
        queue.gate.hold_lets(self.index, origin, Asks::Other, now)
    }
}

impl Plant {
    /// Whether `[authority]` is on for a bus.
    pub fn has_authority(&self) -> bool {
        self.buses.iter().any(|bus| bus.queue.has_authority())
    }

    /// The reservations in force with their ends, to be saved for the next start of the gateway. `now` is `time` on
    /// the calendar.
    pub fn reservations(&self, now: Instant, time: SystemTime) -> Vec<(Instant, KeptReservation)> {
        let of_bus = |bus: &BusHandle| bus.reservations(now, time);
        let guarded = self.buses.iter().filter(|bus| bus.queue.has_authority());
        guarded.flat_map(of_bus).collect()
    }

    /// Restores reservations from before the start.
    pub fn restore_reservations(&self, kept: &[KeptReservation], now: Instant, time: SystemTime) {
        for one in kept {
            let Some(drive) = self.drive_at(&one.machine) else {
                continue;
            };
            let mut queue = drive.bus.queue.lock();
            let rules = queue.gate.rules().cloned();
            let goes_on = rules.and_then(|rules| one.continues_after_start(&rules, now, time));
            if let Some((who, until)) = goes_on {
                queue.gate.reserve(drive.index, who, until);
            }
        }
    }

    /// Publishes what happened to the holds of the drives until `now`, which is `time` on the calendar; to be called several times a
    /// second.
    pub fn publish_holds(&self, now: Instant, time: SystemTime) {
        self.buses
            .iter()
            .for_each(|bus| bus.publish_holds(&self.events, now, time));
    }
}

/// The event for a change of a hold.
fn event_text(told: &HoldChange, rules: &Rules) -> (EventKind, String) {
    let named = |claim: &Claim| format!("{} ({})", claim.name, rules.rank(claim.rank));
    let who = named(&told.who);
    match &told.what {
        What::Held => (EventKind::Held, format!("{who} holds the drive")),
        What::Released(why) => (EventKind::Released, format!("{who} no longer holds the drive: {why}")),
        What::Broken(by) => (
            EventKind::HoldBroken,
            format!("{} took the drive from {who}", named(by)),
        ),
    }
}
