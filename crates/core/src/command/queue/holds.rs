//! Who holds the drives of the bus: `[authority]`, judged where commands are accepted, and again at their turn.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::Pending;
use crate::command::{
    Asks, Claim, Command, Denial, HoldView, Holder, Holding, Mode, Origin, Outcome, Refusal, Rules, Told, Urgency, Verb,
};
use crate::drive::DriveIndex;

/// Most changes of holds waiting to be published, which happens several times a second; beyond that the oldest is
/// dropped.
const MOST_TOLD: usize = 256;
/// A command of a client that does not hold its drive is logged once in this time.
const UNHELD_LOGGED: Duration = Duration::from_secs(60);

/// The holds of the drives of a bus.
#[derive(Debug, Default)]
pub(super) struct Holds {
    rules: Option<Arc<Rules>>,
    drives: BTreeMap<DriveIndex, Holding>,
    told: Vec<(DriveIndex, Told)>,
    /// Drives that a client took since the bus last checked.
    taken: Vec<DriveIndex>,
    /// Commands that were carried out, or would have been refused, though another client held the drive.
    unheld: BTreeMap<DriveIndex, u64>,
    /// The same, to be logged.
    unheld_told: Vec<(DriveIndex, Unheld)>,
    /// When it was last logged of a client.
    unheld_logged: BTreeMap<Arc<str>, Instant>,
}

/// A command that advisory mode carried out.
#[derive(Debug, Clone)]
pub struct Unheld {
    /// Who gave it.
    pub client: Arc<str>,
    /// Why exclusive mode would have refused it.
    pub why: String,
}

impl Holds {
    /// Calls `change` with the rules and the holding of a drive, and the list of its changes; none while `[authority]`
    /// is off.
    fn with<T>(
        &mut self,
        drive: DriveIndex,
        change: impl FnOnce(&mut Holding, &Rules, &mut Vec<Told>) -> T,
    ) -> Option<T> {
        let rules = self.rules.as_ref()?;
        let mut told = Vec::new();
        let holding = self.drives.entry(drive).or_default();
        let before = holding.holder().cloned();
        let changed = change(holding, rules, &mut told);
        let is_new = holding.holder().is_some_and(|holder| Some(holder) != before.as_ref());
        if is_new && !self.taken.contains(&drive) {
            self.taken.push(drive);
        }
        self.told.extend(told.into_iter().map(|told| (drive, told)));
        let beyond = self.told.len().saturating_sub(MOST_TOLD);
        self.told.drain(..beyond);
        Some(changed)
    }

    /// Counts a command that exclusive mode would have refused, and logs it once a client and minute.
    fn count_unheld(&mut self, drive: DriveIndex, origin: &Origin, denial: &Denial, now: Instant) {
        *self.unheld.entry(drive).or_default() += 1;
        let Some(rules) = &self.rules else { return };
        let client = rules
            .claim_of(origin)
            .map_or_else(|| origin.client().clone(), |who| who.name);
        self.unheld_logged.retain(|_, at| now < *at + UNHELD_LOGGED);
        if self.unheld_logged.contains_key(&client) || self.unheld_told.len() >= MOST_TOLD {
            return;
        }
        self.unheld_logged.insert(client.clone(), now);
        let why = match denial.refusal(rules).holder() {
            Some(Holder { who, rank, keeps, .. }) => format!("{who} ({rank}) {keeps}"),
            None => "it is not a principal of [authority]".to_string(),
        };
        self.unheld_told.push((drive, Unheld { client, why }));
    }

    fn claim(&self, origin: &Origin) -> Option<Claim> {
        self.rules.as_ref()?.claim_of(origin)
    }

    /// Why a client's command is refused, in exclusive mode. A run command refused after a stop is remembered.
    fn refuses(&mut self, drive: DriveIndex, origin: &Origin, asks: Asks, now: Instant) -> Option<Refusal> {
        let rules = self.rules.clone().filter(|_| origin.kind.is_client())?;
        let who = rules.claim_of(origin);
        let holding = self.drives.entry(drive).or_default();
        let denial = holding.judge(who.as_ref(), asks, &rules, now).err()?;
        holding.refused(who.as_ref(), asks, &denial, &rules, now);
        (rules.mode == Mode::Exclusive).then(|| denial.refusal(&rules))
    }
}

impl Pending {
    /// Applies new rules; none: `[authority]` is off, and all holds end.
    pub(super) fn set_rules(&mut self, rules: Option<Arc<Rules>>) {
        if self.holds.rules == rules {
            return;
        }
        let drives: Vec<DriveIndex> = self.holds.drives.keys().copied().collect();
        match rules {
            Some(_) => {
                self.holds.rules = rules;
                for drive in drives {
                    self.holds
                        .with(drive, |holding, rules, told| holding.keep_known(rules, told));
                }
            }
            None => {
                for drive in drives {
                    self.hold_ends(drive, "a reload turned [authority] off");
                }
                self.holds.drives.clear();
                self.holds.rules = None;
            }
        }
    }

    /// The hold of a drive ends, for that reason.
    pub(crate) fn hold_ends(&mut self, drive: DriveIndex, why: &str) {
        self.holds.with(drive, |holding, _, told| holding.end(why, told));
    }

    /// Why a command of that client is not accepted, where the hold of the drive keeps it. A run that is refused behind
    /// a stop is kept.
    pub(crate) fn hold_refuses(
        &mut self,
        drive: DriveIndex,
        origin: &Origin,
        asks: Asks,
        now: Instant,
    ) -> Option<Refusal> {
        self.holds.refuses(drive, origin, asks, now)
    }

    /// The same of a command to all that it reaches.
    pub(super) fn hold_refuses_command(&mut self, command: &Command, now: Instant) -> Option<Refusal> {
        self.holds.rules.as_ref()?;
        let origin = command.ticket.origin();
        let reach = command.reach().iter();
        reach
            .map(|drive| (*drive, Asks::of(command, *drive)))
            .collect::<Vec<_>>()
            .into_iter()
            .find_map(|(drive, asks)| self.holds.refuses(drive, origin, asks, now))
    }

    /// The turn of a command that was accepted: why it is not sent, if its client has lost the drive since. A drive that is free
    /// by now, since its client released it or the lease ended, is taken as by any order.
    pub fn hold_at_turn(&mut self, command: &Command, now: Instant) -> Option<Refusal> {
        let refusal = self.hold_stops_turn(command, now);
        let origin = command.ticket.origin();
        let who = self.holds.claim(origin).filter(|_| origin.kind.is_client());
        if let (None, Some(who)) = (&refusal, who) {
            for drive in command.reach() {
                let asks = Asks::of(command, *drive);
                self.holds.with(*drive, |holding, rules, told| {
                    holding.turn_came(&who, asks, rules, now, told)
                });
            }
        }
        refusal
    }

    fn hold_stops_turn(&self, command: &Command, now: Instant) -> Option<Refusal> {
        let rules = self.holds.rules.as_ref()?;
        let origin = command.ticket.origin();
        if rules.mode == Mode::Advisory || !origin.kind.is_client() {
            return None;
        }
        let who = rules.claim_of(origin);
        command.reach().iter().find_map(|drive| {
            // Stops that it has accepted are sent.
            let asks = Some(Asks::of(command, *drive)).filter(|asks| *asks != Asks::Stop)?;
            let denial = self
                .holds
                .drives
                .get(drive)?
                .judge(who.as_ref(), asks, rules, now)
                .err()?;
            Some(denial.refusal(rules))
        })
    }

    /// A command is taken in.
    pub(super) fn hold_accepted(&mut self, command: &Command, now: Instant) {
        // Of a stop that another bus took in, it was noted there.
        if self.holds.rules.is_none() || command.urgency == Urgency::Read || command.effects.is_empty() {
            return;
        }
        let origin = command.ticket.origin();
        let who = self.holds.claim(origin);
        for drive in command.reach() {
            let asks = Asks::of(command, *drive);
            if !origin.kind.is_client() {
                let supervision = origin.is_lease();
                if asks == Asks::Stop {
                    self.holds.with(*drive, |holding, rules, told| {
                        holding.stopped_by_gateway(supervision, rules, now, told);
                    });
                }
                continue;
            }
            let unheld = self.holds.with(*drive, |holding, rules, told| {
                let unheld = holding.judge(who.as_ref(), asks, rules, now).err();
                holding.accepted(who.as_ref(), asks, rules, now, told);
                unheld
            });
            if let Some(denial) = unheld.flatten() {
                self.holds.count_unheld(*drive, origin, &denial, now);
            }
        }
    }

    /// A stop of that client is taken in, as [`Pending::hold_accepted`] notes it.
    pub(super) fn hold_stopped(&mut self, drive: DriveIndex, origin: &Origin, now: Instant) {
        let who = self.holds.claim(origin);
        self.holds.with(drive, |holding, rules, told| {
            holding.accepted(who.as_ref(), Asks::Stop, rules, now, told);
        });
    }

    /// A client was received from: its heartbeat came, or its order was carried out.
    pub fn hold_renewed(&mut self, drive: DriveIndex, origin: &Origin, now: Instant) {
        let Some(who) = self.holds.claim(origin) else { return };
        self.holds
            .with(drive, |holding, rules, _| holding.renew(&who, rules, now));
    }

    /// The drive acknowledged a stop of that client.
    pub fn hold_stop_acknowledged(&mut self, drive: DriveIndex, origin: &Origin) {
        let Some(who) = self.holds.claim(origin) else { return };
        self.holds.with(drive, |holding, _, _| holding.stop_acknowledged(&who));
    }

    /// Whether supervision follows that client: it holds the drive, or was the last holder, or there was none.
    pub(crate) fn hold_renews(&self, drive: DriveIndex, origin: &Origin) -> bool {
        let Some(holding) = self.holds.rules.as_ref().and_then(|_| self.holds.drives.get(&drive)) else {
            return true;
        };
        holding.is_whose_silence_counts(self.holds.claim(origin).as_ref())
    }

    /// Applies a client's action to a hold. Waiting commands of other clients end.
    ///
    /// # Errors
    /// Why it may not; none while `[authority]` is off.
    pub(crate) fn hold_act(
        &mut self,
        drive: DriveIndex,
        origin: &Origin,
        verb: Verb,
        now: Instant,
    ) -> Option<Result<(), Refusal>> {
        let rules = self.holds.rules.clone()?;
        let who = rules.claim_of(origin);
        let acted = self.holds.with(drive, |holding, rules, told| {
            holding.act(who.as_ref(), verb, rules, now, told)
        })?;
        if acted.is_ok() && matches!(verb, Verb::Take | Verb::Break) {
            self.drop_of_others(drive, now);
        }
        Some(acted.map_err(|denial: Denial| denial.refusal(&rules)))
    }

    /// Drops waiting commands that are no longer the holder's.
    fn drop_of_others(&mut self, drive: DriveIndex, now: Instant) {
        let mut index = 0;
        while let Some(command) = self.waiting.get(index) {
            let refusal = match command.reaches(drive) {
                true => self.hold_stops_turn(command, now),
                false => None,
            };
            match refusal.and_then(|refusal| Some((self.waiting.remove(index)?, refusal))) {
                Some((command, refusal)) => command.answer(&Outcome::Refused(refusal), now),
                None => index += 1,
            }
        }
    }

    /// Drives with a new holder since the last call: started commands of others end.
    pub fn take_taken(&mut self) -> Vec<DriveIndex> {
        std::mem::take(&mut self.holds.taken)
    }

    /// Why a client's started command ends, if another client has taken the drive since.
    pub fn hold_ends_run(&self, drive: DriveIndex, origin: &Origin, now: Instant) -> Option<Refusal> {
        let rules = self.holds.rules.as_ref().filter(|_| origin.kind.is_client())?;
        let who = rules.claim_of(origin).filter(|_| rules.mode == Mode::Exclusive);
        who.as_ref()?;
        let holding = self.holds.drives.get(&drive)?;
        let denial = holding.judge(who.as_ref(), Asks::Steer, rules, now).err()?;
        Some(denial.refusal(rules))
    }

    /// The client stopped, though nothing is sent for it.
    pub(crate) fn hold_said_stop(&mut self, drive: DriveIndex, origin: &Origin) {
        let Some(who) = self.holds.claim(origin) else { return };
        self.holds.with(drive, |holding, _, _| holding.said_stop(&who));
    }

    /// Whether the local control place of a drive has it now.
    pub fn set_local(&mut self, drive: DriveIndex, local: bool) {
        self.holds
            .with(drive, |holding, _, told| holding.set_local(local, told));
    }

    /// Ends what has expired, and returns the changes since the last call.
    pub fn take_told(&mut self, now: Instant) -> Vec<(DriveIndex, Told)> {
        let drives: Vec<DriveIndex> = self.holds.drives.keys().copied().collect();
        for drive in drives {
            self.holds
                .with(drive, |holding, rules, told| holding.settle(rules, now, told));
        }
        std::mem::take(&mut self.holds.told)
    }

    /// Commands of clients that did not hold their drive, to be logged.
    pub fn take_unheld(&mut self) -> Vec<(DriveIndex, Unheld)> {
        std::mem::take(&mut self.holds.unheld_told)
    }

    /// Whether that client writes its command word all the time, so that its repeated stop is no new one.
    pub(super) fn is_cyclic(&self, origin: &Origin) -> bool {
        self.holds.claim(origin).is_some_and(|who| who.cyclic)
    }

    /// The published state of a hold, and whether that client has it.
    pub fn hold_view(&self, drive: DriveIndex, origin: Option<&Origin>, now: Instant) -> Option<(HoldView, bool)> {
        let rules = self.holds.rules.as_ref()?;
        let free = Holding::default();
        let holding = self.holds.drives.get(&drive).unwrap_or(&free);
        let who = origin.and_then(|origin| rules.claim_of(origin));
        let own = who.is_some_and(|who| holding.is_held_by(&who, now));
        Some((holding.view(rules, now), own))
    }

    /// The client whose repeated stops end the holds of others.
    pub(crate) fn repeater(&self, drive: DriveIndex) -> Option<Arc<str>> {
        self.holds.drives.get(&drive)?.repeater().cloned()
    }

    /// Commands that were carried out in advisory mode though another client held the drive.
    pub fn unheld(&self, drive: DriveIndex) -> u64 {
        self.holds.unheld.get(&drive).copied().unwrap_or_default()
    }

    /// The rules, where `[authority]` is on.
    pub fn rules(&self) -> Option<&Arc<Rules>> {
        self.holds.rules.as_ref()
    }

    /// The reservation of a drive: until when, for whom by name and rank, and for how long such a one lasts.
    pub(crate) fn reservation(&self, drive: DriveIndex, now: Instant) -> Option<(Instant, String, String, Duration)> {
        let rules = self.holds.rules.as_ref()?;
        let (who, until) = self.holds.drives.get(&drive)?.reservation()?;
        let rank = rules.rank(who.rank).to_string();
        (until > now).then(|| (until, who.name.to_string(), rank, rules.lease))
    }

    /// A stop before the start of the process reserved the drive.
    pub fn reserve(&mut self, drive: DriveIndex, who: Claim, until: Instant) {
        self.holds.with(drive, |holding, _, _| holding.reserve(who, until));
    }

    /// The hold of a drive, for the bus that takes the place of this one.
    pub fn holding(&self, drive: DriveIndex) -> Option<Holding> {
        self.holds.drives.get(&drive).cloned()
    }

    /// Continues the hold of the same machine after a reload.
    pub(crate) fn take_over_holding(&mut self, drive: DriveIndex, mut holding: Holding) {
        // The next reading says it again.
        holding.set_local(false, &mut Vec::new());
        self.holds.drives.insert(drive, holding);
    }
}
