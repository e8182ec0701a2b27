//! The holders of the drives of the bus, where `[authority]` is on: changes by accepted and refused orders.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{DriveGate, Gate};
use crate::order::{Asks, Command, Holder, Origin, Refusal};
use crate::permit::holder::{Claim, Denial, HoldChange, HoldView, Holding, Mode, Rules, Verb};
use crate::permit::judge::Ask;
use drivegate_model::drive::DriveIndex;

/// Maximum number of changes of holds that wait to be published, which happens several times a second; beyond that the
/// oldest is dropped.
const MOST_TOLD: usize = 256;
/// Interval at which commands of a client that does not hold the drive are logged.
const UNHELD_LOGGED: Duration = Duration::from_secs(60);

/// Changes of holds that are to be published, and commands to be logged.
#[derive(Debug, Default)]
pub(super) struct HoldNews {
    told: Vec<(DriveIndex, HoldChange)>,
    unheld: Vec<(DriveIndex, Unheld)>,
    /// When a command of a client that did not hold its drive was last logged.
    logged: BTreeMap<Arc<str>, Instant>,
}

/// A command that advisory mode carried out.
#[derive(Debug, Clone)]
pub struct Unheld {
    /// Client that gave the order.
    pub client: Arc<str>,
    /// Reason why exclusive mode would have refused the order.
    pub why: String,
}

impl HoldNews {
    fn record_changes(&mut self, drive: DriveIndex, told: Vec<HoldChange>) {
        self.told.extend(told.into_iter().map(|told| (drive, told)));
        let beyond = self.told.len().saturating_sub(MOST_TOLD);
        self.told.drain(..beyond);
    }

    /// Notes a command that exclusive mode would have refused, for the log: once per client and minute.
    fn note_unheld(&mut self, drive: DriveIndex, client: Arc<str>, denial: &Denial, rules: &Rules, now: Instant) {
        self.logged.retain(|_, at| now < *at + UNHELD_LOGGED);
        if self.logged.contains_key(&client) || self.unheld.len() >= MOST_TOLD {
            return;
        }
        self.logged.insert(client.clone(), now);
        let why = match denial.refusal(rules).holder() {
            Some(Holder { who, rank, keeps, .. }) => format!("{who} ({rank}) {keeps}"),
            None => "it is not a principal of [authority]".to_string(),
        };
        self.unheld.push((drive, Unheld { client, why }));
    }
}

impl Gate {
    /// Calls `change` with the rules and the holding of a drive, and with the list of its changes; `None` while
    /// `[authority]` is off.
    fn with_hold<T>(
        &mut self,
        drive: DriveIndex,
        change: impl FnOnce(&mut Holding, &Rules, &mut Vec<HoldChange>) -> T,
    ) -> Option<T> {
        let rules = self.rules.clone()?;
        let mut told = Vec::new();
        let changed = change(&mut self.drive(drive).holding, &rules, &mut told);
        self.hold_news.record_changes(drive, told);
        Some(changed)
    }

    /// Applies new rules; with `None`, `[authority]` is off and all holds end.
    pub(crate) fn set_rules(&mut self, rules: Option<Arc<Rules>>) {
        if self.rules == rules {
            return;
        }
        let drives: Vec<DriveIndex> = self.drives.keys().copied().collect();
        if rules.is_some() {
            self.rules = rules;
            for drive in drives {
                self.with_hold(drive, |holding, rules, told| holding.keep_known(rules, told));
            }
            return;
        }
        for drive in drives {
            self.hold_ends(drive, "a reload turned [authority] off");
            self.drive(drive).holding = Holding::default();
        }
        self.rules = None;
    }

    /// The hold of a drive ends, for that reason.
    pub(crate) fn hold_ends(&mut self, drive: DriveIndex, why: &str) {
        self.with_hold(drive, |holding, _, told| holding.end(why, told));
    }

    /// Remembers a run command that was refused after a stop, so that its client does not start the motor by repeating it.
    pub(super) fn note_refused_run(&mut self, ask: &Ask<'_>) {
        let Some(rules) = self.rules.clone().filter(|_| ask.origin.kind.is_client()) else {
            return;
        };
        let who = rules.claim_of(ask.origin);
        let holding = &mut self.drive(ask.drive).holding;
        if let Err(denial) = holding.judge(who.as_ref(), ask.asks(), &rules, ask.now) {
            holding.refused(who.as_ref(), ask.asks(), &denial, &rules, ask.now);
        }
    }

    /// Checks whether a client may start an action that requires `asks` of the hold, before any order is given.
    ///
    /// # Errors
    /// If the hold prevents it; contains the refusal.
    pub(crate) fn hold_lets(
        &self,
        drive: DriveIndex,
        origin: &Origin,
        asks: Asks,
        now: Instant,
    ) -> Result<(), Refusal> {
        let nothing_known = DriveGate::default();
        let drive = self.drives.get(&drive).unwrap_or(&nothing_known);
        self.judge_hold(drive, origin, asks, now).map_or(Ok(()), Err)
    }

    /// The refusal of a client's order, in exclusive mode, because of the hold of the drive.
    pub(in crate::permit) fn judge_hold(
        &self,
        drive: &DriveGate,
        origin: &Origin,
        asks: Asks,
        now: Instant,
    ) -> Option<Refusal> {
        let rules = self.rules.as_ref().filter(|rules| rules.mode == Mode::Exclusive)?;
        if !origin.kind.is_client() {
            return None;
        }
        let denial = drive
            .holding
            .judge(rules.claim_of(origin).as_ref(), asks, rules, now)
            .err()?;
        Some(denial.refusal(rules))
    }

    /// Notes that an accepted command is about to be sent: it takes the hold again if the hold has ended since.
    pub(super) fn hold_turn_came(&mut self, command: &Command, now: Instant) {
        let origin = command.ticket.origin();
        let Some(who) = self.claim(origin).filter(|_| origin.kind.is_client()) else {
            return;
        };
        for (drive, effect) in command.intent.effects.iter() {
            let asks = Asks::of(&command.intent.order, effect);
            self.with_hold(drive, |holding, rules, told| {
                holding.turn_came(&who, asks, rules, now, told);
            });
        }
    }

    /// Notes an accepted command of a client.
    pub(super) fn hold_accepted(&mut self, command: &Command, now: Instant) {
        // A stop accepted by another bus before a reload was recorded there.
        let Some(rules) = self.rules.clone().filter(|_| !command.is_inherited()) else {
            return;
        };
        let origin = command.ticket.origin();
        let who = rules.claim_of(origin);
        for (drive, effect) in command.intent.effects.iter() {
            let asks = Asks::of(&command.intent.order, effect);
            if !origin.kind.is_client() {
                if asks == Asks::Stop {
                    let supervision = origin.is_lease();
                    self.with_hold(drive, |holding, rules, told| {
                        holding.stopped_by_gateway(supervision, rules, now, told);
                    });
                }
                continue;
            }
            let unheld = self.with_hold(drive, |holding, rules, told| {
                let unheld = holding.judge(who.as_ref(), asks, rules, now).err();
                holding.accepted(who.as_ref(), asks, rules, now, told);
                unheld
            });
            if let Some(denial) = unheld.flatten() {
                self.drive(drive).unheld += 1;
                let client = who
                    .as_ref()
                    .map_or_else(|| origin.client().clone(), |who| who.name.clone());
                self.hold_news.note_unheld(drive, client, &denial, &rules, now);
            }
        }
    }

    /// A stop of that client joins one that was accepted before, and is noted as any stop.
    pub(super) fn hold_stopped(&mut self, drive: DriveIndex, origin: &Origin, now: Instant) {
        self.needs_no_stop(drive, origin);
        let who = self.claim(origin);
        self.with_hold(drive, |holding, rules, told| {
            holding.accepted(who.as_ref(), Asks::Stop, rules, now, told);
        });
    }

    /// Notes a sign of life of a client: a heartbeat, or an order that was carried out.
    pub fn hold_renewed(&mut self, drive: DriveIndex, origin: &Origin, now: Instant) {
        let Some(who) = self.claim(origin) else { return };
        self.with_hold(drive, |holding, rules, _| holding.renew(&who, rules, now));
    }

    /// The drive acknowledged a stop of that client.
    pub fn hold_stop_acknowledged(&mut self, drive: DriveIndex, origin: &Origin) {
        let Some(who) = self.claim(origin) else { return };
        self.with_hold(drive, |holding, _, _| holding.stop_acknowledged(&who));
    }

    /// Whether supervision watches this client: it holds the drive, was the last holder, or the drive never had one.
    pub fn hold_renews(&self, drive: DriveIndex, origin: &Origin) -> bool {
        let known = self.rules.as_ref().and_then(|_| self.drives.get(&drive));
        known.is_none_or(|drive| drive.holding.is_whose_silence_counts(self.claim(origin).as_ref()))
    }

    /// Applies a client's action to a hold. Waiting or started orders of other clients are refused at their next check.
    ///
    /// # Errors
    /// If the client may not do that; never while `[authority]` is off.
    pub(crate) fn hold_act(
        &mut self,
        drive: DriveIndex,
        origin: &Origin,
        verb: Verb,
        now: Instant,
    ) -> Option<Result<(), Refusal>> {
        let rules = self.rules.clone()?;
        let who = rules.claim_of(origin);
        if matches!(verb, Verb::Take | Verb::Break) {
            self.needs_no_stop(drive, origin);
        }
        let acted = self.with_hold(drive, |holding, rules, told| {
            holding.act(who.as_ref(), verb, rules, now, told)
        })?;
        Some(acted.map_err(|denial: Denial| denial.refusal(&rules)))
    }

    /// The client stopped the drive, though nothing is sent for that.
    pub(crate) fn hold_said_stop(&mut self, drive: DriveIndex, origin: &Origin) {
        self.needs_no_stop(drive, origin);
        let Some(who) = self.claim(origin) else { return };
        self.with_hold(drive, |holding, _, _| holding.said_stop(&who));
    }

    /// Records that the client knows which machine it commands, so it need not send a stop, or take the drive,
    /// before a start.
    fn needs_no_stop(&mut self, drive: DriveIndex, origin: &Origin) {
        self.drive(drive)
            .must_stop_first
            .retain(|client| client != origin.client());
    }

    /// Sets whether the drive is under local control now.
    pub fn set_local(&mut self, drive: DriveIndex, local: bool) {
        self.with_hold(drive, |holding, _, told| holding.set_local(local, told));
    }

    /// Ends holds that have expired, and returns the changes since the last call.
    pub fn take_changes(&mut self, now: Instant) -> Vec<(DriveIndex, HoldChange)> {
        let drives: Vec<DriveIndex> = self.drives.keys().copied().collect();
        for drive in drives {
            self.with_hold(drive, |holding, rules, told| holding.settle(rules, now, told));
        }
        std::mem::take(&mut self.hold_news.told)
    }

    /// Commands of clients that did not hold their drive, to be logged.
    pub fn take_unheld(&mut self) -> Vec<(DriveIndex, Unheld)> {
        std::mem::take(&mut self.hold_news.unheld)
    }

    /// Whether the client writes its command word continuously, so that its repeated stop is not a new one.
    pub(crate) fn is_cyclic(&self, origin: &Origin) -> bool {
        self.claim(origin).is_some_and(|who| who.cyclic)
    }

    /// Whether a stop of this client does not count as one, because the client repeats its command word cyclically
    /// and its last word was a stop.
    pub(super) fn repeats_its_word(&self, drive: DriveIndex, origin: &Origin) -> bool {
        let Some(drive) = self.drives.get(&drive) else {
            return false;
        };
        self.claim(origin).is_some_and(|who| drive.holding.repeats(&who))
    }

    /// The published state of a hold, and whether the client has it.
    pub fn hold_view(&self, drive: DriveIndex, origin: Option<&Origin>, now: Instant) -> Option<(HoldView, bool)> {
        let rules = self.rules.as_ref()?;
        let free = Holding::default();
        let holding = self.drives.get(&drive).map_or(&free, |drive| &drive.holding);
        let who = origin.and_then(|origin| rules.claim_of(origin));
        let own = who.is_some_and(|who| holding.is_held_by(&who, now));
        Some((holding.view(rules, now), own))
    }

    /// The client whose repeated stops end the holds of others.
    pub(crate) fn repeater(&self, drive: DriveIndex) -> Option<Arc<str>> {
        self.drives.get(&drive)?.holding.repeater().cloned()
    }

    /// Commands that were carried out in advisory mode though another client held the drive.
    pub fn unheld(&self, drive: DriveIndex) -> u64 {
        self.drives.get(&drive).map_or(0, |drive| drive.unheld)
    }

    /// The rules of `[authority]`; `None` if it is off.
    pub fn rules(&self) -> Option<&Arc<Rules>> {
        self.rules.as_ref()
    }

    /// The reservation of a drive: until when, for whom by name and rank, and for how long such a one lasts.
    pub(crate) fn reservation(&self, drive: DriveIndex, now: Instant) -> Option<(Instant, String, String, Duration)> {
        let rules = self.rules.as_ref()?;
        let (who, until) = self.drives.get(&drive)?.holding.reservation()?;
        let rank = rules.rank(who.rank).to_string();
        (until > now).then(|| (until, who.name.to_string(), rank, rules.lease))
    }

    /// A stop before the start of the process reserved the drive.
    pub fn reserve(&mut self, drive: DriveIndex, who: Claim, until: Instant) {
        self.with_hold(drive, |holding, _, _| holding.reserve(who, until));
    }
}
