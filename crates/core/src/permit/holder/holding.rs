//! The hold of one drive: holder, remaining time, and reservations after a stop. Pure: time is an argument.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::denial::seconds;
use super::{Claim, Denial, Mode, Rules};
use crate::order::Asks;

/// Leases without a run command after which a client refused after a stop is forgotten.
const FORGOTTEN_AFTER: u32 = 10;
/// The name of the gateway's own stop after a client went silent.
const SUPERVISION: &str = "supervision";
/// Maximum number of clients whose last command word is remembered.
const MOST_STOOD: usize = 256;

/// An action on the hold of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verb {
    /// Takes a free drive, or renews the client's own hold.
    Take,
    /// Renews the hold that the client has.
    Renew,
    /// Releases the drive; without effect for a client that does not hold it.
    Release,
    /// Takes the drive from a client of lower rank.
    Break,
}

impl Verb {
    /// All actions.
    pub const ALL: [Verb; 4] = [Verb::Take, Verb::Renew, Verb::Release, Verb::Break];

    /// Name of the action.
    pub fn name(self) -> &'static str {
        match self {
            Verb::Take => "take",
            Verb::Renew => "renew",
            Verb::Release => "release",
            Verb::Break => "break",
        }
    }

    /// The action with this name.
    pub fn of(name: &str) -> Option<Verb> {
        Verb::ALL.into_iter().find(|verb| verb.name() == name)
    }
}

/// Kind of holder of a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HoldState {
    /// The drive has no holder.
    Free,
    /// A client holds the drive.
    Held,
    /// A stop has reserved the drive for a client.
    Reserved,
    /// The drive is under local control.
    Local,
}

impl HoldState {
    /// Name of the state.
    pub fn name(self) -> &'static str {
        match self {
            HoldState::Free => "free",
            HoldState::Held => "held",
            HoldState::Reserved => "reserved",
            HoldState::Local => "local",
        }
    }
}

/// The published state of a hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HoldView {
    /// Kind of holder.
    pub state: HoldState,
    /// The holder, or the client whose stop reserved the drive.
    pub holder: Option<Arc<str>>,
    /// Name of the holder's rank.
    pub rank: Option<Arc<str>>,
    /// Seconds left, rounded up; 0 if the drive is free, `None` for local control.
    pub left_s: Option<u64>,
}

/// A change of a hold, for an event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HoldChange {
    /// The client whose hold changed.
    pub who: Claim,
    /// How the hold changed.
    pub what: What,
}

/// A change of a hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum What {
    /// The hold started.
    Held,
    /// The hold ended, for this reason.
    Released(String),
    /// Another client, named here, broke the hold.
    Broken(Claim),
}

#[derive(Debug, Clone, Default)]
enum State {
    #[default]
    Free,
    Held(Claim, Instant),
    Reserved(Claim, Instant),
}

/// A client whose run command was refused after a stop.
#[derive(Debug, Clone)]
struct Waiting {
    who: Claim,
    /// Client whose stop prevents the command.
    stopper: Claim,
    /// When the client last tried to run.
    tried: Instant,
}

/// A client whose last command word was a stop.
#[derive(Debug, Clone)]
struct LastStop {
    name: Arc<str>,
    /// Whether the drive acknowledged the stop.
    acknowledged: bool,
}

/// The hold of one drive.
#[derive(Debug, Clone, Default)]
pub struct Holding {
    state: State,
    local: bool,
    /// The last holder. Its silence is the one that is measured.
    last: Option<Claim>,
    /// Clients that must take the drive; at most as many as principals.
    waiting: Vec<Waiting>,
    /// The clients whose last command word was a stop.
    stood: Vec<LastStop>,
    /// Client whose run command was accepted last.
    starter: Option<Claim>,
    /// A client that is not configured as cyclic but ended the hold of another by repeating its last stop, over an interface
    /// that programs use cyclically.
    repeater: Option<Arc<str>>,
}

impl Holding {
    /// Ends the hold or reservation if it has expired.
    pub fn settle(&mut self, rules: &Rules, now: Instant, told: &mut Vec<HoldChange>) {
        match &self.state {
            State::Held(_, until) if *until <= now => self.ends("its lease ended", told),
            State::Reserved(_, until) if *until <= now => self.state = State::Free,
            _ => {}
        }
        let time = rules.lease * FORGOTTEN_AFTER;
        self.waiting
            .retain(|waiting| now.saturating_duration_since(waiting.tried) < time);
    }

    /// Ends a hold; a reservation stays.
    fn ends(&mut self, why: &str, told: &mut Vec<HoldChange>) {
        if let State::Held(who, _) = &self.state {
            told.push(HoldChange {
                who: who.clone(),
                what: What::Released(why.to_string()),
            });
            self.state = State::Free;
        }
    }

    fn held(&self, now: Instant) -> Option<(&Claim, Duration)> {
        match &self.state {
            State::Held(by, until) if *until > now => Some((by, *until - now)),
            _ => None,
        }
    }

    fn reserved(&self, now: Instant) -> Option<(&Claim, Duration)> {
        match &self.state {
            State::Reserved(by, until) if *until > now => Some((by, *until - now)),
            _ => None,
        }
    }

    /// Whether a command of this client passes. Being a principal grants no right to write: that was checked before.
    ///
    /// # Errors
    /// If the command does not pass, the reason; in advisory mode, why exclusive mode would refuse it.
    pub fn judge(&self, who: Option<&Claim>, asks: Asks, rules: &Rules, now: Instant) -> Result<(), Denial> {
        match (asks, who) {
            (Asks::Nothing, _) | (Asks::Stop, None) => return Ok(()),
            (_, None) => return Err(Denial::Nobody),
            (Asks::Stop, Some(who)) => return self.repeats_in_vain(who, now).map_or(Ok(()), Err),
            (Asks::Run | Asks::Steer | Asks::Other, Some(_)) => {}
        }
        let Some(who) = who else { return Ok(()) };
        if self.local {
            return Err(Denial::Local);
        }
        if let Some((by, left)) = self.held(now).filter(|(by, _)| !by.is(who)) {
            let breaks = who.breaks && by.is_below(who) && asks.takes_hold();
            if !breaks {
                return Err(Denial::Held(by.clone(), left));
            }
        }
        if let Some((by, left)) = self.reserved(now).filter(|(by, _)| who.is_below(by)) {
            return Err(Denial::Reserved(by.clone(), left));
        }
        let waits = self.waiting.iter().find(|waiting| waiting.who.is(who));
        let is_due = |waiting: &&Waiting| now.saturating_duration_since(waiting.tried) < rules.lease * FORGOTTEN_AFTER;
        // The take is required even of a client that holds the drive by a reference.
        match waits.filter(is_due).filter(|_| asks == Asks::Run) {
            Some(waiting) => Err(Denial::NeedsTake(waiting.stopper.clone())),
            None => Ok(()),
        }
    }

    /// Why the stop of a cyclic client is not sent: it repeats a stop that the drive acknowledged, and another
    /// client holds the drive or started the motor last.
    fn repeats_in_vain(&self, who: &Claim, now: Instant) -> Option<Denial> {
        let is_acknowledged = |stood: &LastStop| stood.acknowledged && stood.name == who.name;
        if !who.cyclic || !self.stood.iter().any(is_acknowledged) {
            return None;
        }
        let starter = self.starter.as_ref().map(|starter| (starter, Duration::ZERO));
        let mut others = self.held(now).into_iter().chain(starter).filter(|(by, _)| !by.is(who));
        others.next().map(|(by, left)| Denial::Repeats(by.clone(), left))
    }

    /// A command was refused; a run command after a stop is remembered.
    pub fn refused(&mut self, who: Option<&Claim>, asks: Asks, denial: &Denial, rules: &Rules, now: Instant) {
        self.note_word(who, asks);
        let Some(who) = who.filter(|_| asks == Asks::Run && rules.mode == Mode::Exclusive) else {
            return;
        };
        let (Denial::Reserved(stopper, _) | Denial::NeedsTake(stopper)) = denial else {
            return;
        };
        match self.waiting.iter_mut().find(|waiting| waiting.who.is(who)) {
            Some(waiting) => waiting.tried = now,
            None => self.waiting.push(Waiting {
                who: who.clone(),
                stopper: stopper.clone(),
                tried: now,
            }),
        }
    }

    /// A command was accepted.
    pub fn accepted(
        &mut self,
        who: Option<&Claim>,
        asks: Asks,
        rules: &Rules,
        now: Instant,
        told: &mut Vec<HoldChange>,
    ) {
        self.settle(rules, now, told);
        let repeats = asks == Asks::Stop && who.is_some_and(|who| self.repeats(who));
        let is_other = |by: &Claim| who.is_some_and(|who| !by.is(who));
        let ends = asks == Asks::Stop && !repeats && self.held(now).is_some_and(|(by, _)| is_other(by));
        if let Some(who) = who.filter(|who| ends && who.may_repeat && self.has_stopped(who)) {
            self.repeater = Some(who.name.clone());
        }
        self.note_word(who, asks);
        if asks == Asks::Run {
            self.starter = Some(who.cloned().unwrap_or_else(Claim::nobody));
        }
        match (asks, who) {
            (Asks::Nothing, _) => {}
            (Asks::Stop, _) if repeats => {}
            (Asks::Stop, None) => self.ends("someone stopped the drive", told),
            (Asks::Stop, Some(who)) => self.stopped(who, rules, now, told),
            (Asks::Run | Asks::Steer, Some(who)) => self.taken(who, rules, now, told),
            (Asks::Other, Some(who)) => self.renew(who, rules, now),
            (Asks::Run | Asks::Steer | Asks::Other, None) => {}
        }
    }

    fn stopped(&mut self, who: &Claim, rules: &Rules, now: Instant, told: &mut Vec<HoldChange>) {
        self.said_stop(who);
        match &self.state {
            State::Held(by, _) if by.is(who) => return self.renew(who, rules, now),
            State::Reserved(by, _) if who.is_below(by) => return,
            State::Held(..) => self.ends(&format!("{} stopped the drive", who.name), told),
            State::Free | State::Reserved(..) => {}
        }
        self.state = State::Reserved(who.clone(), now + rules.lease);
    }

    /// A stop by supervision reserves the drive with the rank of the client that went silent. Any other stop by the
    /// gateway itself reserves nothing.
    pub fn stopped_by_gateway(&mut self, supervision: bool, rules: &Rules, now: Instant, told: &mut Vec<HoldChange>) {
        self.settle(rules, now, told);
        self.ends("the gateway stopped the drive", told);
        let Some(silent) = self.last.as_ref().filter(|_| supervision) else {
            return;
        };
        let stopper = Claim {
            name: SUPERVISION.into(),
            rank: silent.rank,
            cyclic: false,
            may_repeat: false,
            breaks: false,
        };
        if !matches!(&self.state, State::Reserved(by, _) if stopper.is_below(by)) {
            self.state = State::Reserved(stopper, now + rules.lease);
        }
    }

    /// Notes that the client stopped or released the run command: its next run command then no longer continues a
    /// refused one.
    pub fn said_stop(&mut self, who: &Claim) {
        self.waiting.retain(|waiting| !waiting.who.is(who));
    }

    fn taken(&mut self, who: &Claim, rules: &Rules, now: Instant, told: &mut Vec<HoldChange>) {
        if self.local {
            return;
        }
        let held = What::Held;
        match &self.state {
            State::Held(by, _) if by.is(who) => {}
            State::Held(by, _) if rules.mode == Mode::Exclusive => told.push(HoldChange {
                who: by.clone(),
                what: What::Broken(who.clone()),
            }),
            State::Held(..) => {
                self.ends(&format!("{} commanded the drive", who.name), told);
                told.push(HoldChange {
                    who: who.clone(),
                    what: held,
                });
            }
            State::Free | State::Reserved(..) => told.push(HoldChange {
                who: who.clone(),
                what: held,
            }),
        }
        self.last = Some(who.clone());
        self.state = State::Held(who.clone(), now + rules.lease);
    }

    /// Notes that the turn of an accepted command came and that it passes: the command takes the hold again if that has
    /// ended since.
    pub(crate) fn turn_came(
        &mut self,
        who: &Claim,
        asks: Asks,
        rules: &Rules,
        now: Instant,
        told: &mut Vec<HoldChange>,
    ) {
        self.settle(rules, now, told);
        if asks.takes_hold() && rules.mode == Mode::Exclusive && !self.is_held_by(who, now) {
            self.taken(who, rules, now, told);
        }
    }

    /// Renews the hold of a client whose command was executed or whose heartbeat arrived. A lease is never shortened.
    pub fn renew(&mut self, who: &Claim, rules: &Rules, now: Instant) {
        if let State::Held(by, until) = &mut self.state
            && by.is(who)
            && *until > now
        {
            *until = (*until).max(now + rules.lease);
        }
    }

    /// Applies a client's action to the hold.
    ///
    /// # Errors
    /// If the client may not do that, the reason.
    pub fn act(
        &mut self,
        who: Option<&Claim>,
        verb: Verb,
        rules: &Rules,
        now: Instant,
        told: &mut Vec<HoldChange>,
    ) -> Result<(), Denial> {
        self.settle(rules, now, told);
        let who = who.ok_or(Denial::Nobody)?;
        if verb == Verb::Release {
            self.release(who, told);
            return Ok(());
        }
        if self.local {
            return Err(Denial::Local);
        }
        match &self.state {
            State::Held(by, _) if by.is(who) => self.renew(who, rules, now),
            State::Held(by, _) if verb == Verb::Break && by.is_below(who) => self.taken(who, rules, now, told),
            State::Held(by, until) => return Err(Denial::Held(by.clone(), *until - now)),
            State::Reserved(by, until) if who.is_below(by) => return Err(Denial::Reserved(by.clone(), *until - now)),
            State::Free | State::Reserved(..) if verb == Verb::Renew => return Err(Denial::NotHeld),
            State::Free | State::Reserved(..) => self.taken(who, rules, now, told),
        }
        if verb != Verb::Renew {
            self.said_stop(who);
        }
        Ok(())
    }

    fn release(&mut self, who: &Claim, told: &mut Vec<HoldChange>) {
        match &self.state {
            State::Held(by, _) if by.is(who) => self.ends("its holder released it", told),
            State::Reserved(by, _) if by.is(who) => self.state = State::Free,
            _ => {}
        }
        self.waiting.retain(|waiting| !waiting.stopper.is(who));
    }

    /// Sets whether the drive is under local control. That ends a hold, but not a reservation.
    pub fn set_local(&mut self, local: bool, told: &mut Vec<HoldChange>) {
        if local && !self.local {
            self.ends("the drive was switched to its local control place", told);
        }
        self.local = local;
    }

    /// Whether the drive is under local control, as last reported.
    pub fn is_local(&self) -> bool {
        self.local
    }

    /// After a reload: principals that were removed hold nothing, and changed ones get their new rank.
    pub(crate) fn keep_known(&mut self, rules: &Rules, told: &mut Vec<HoldChange>) {
        if let State::Held(by, _) = &self.state
            && !rules.is_configured(by)
        {
            self.ends("a reload removed it from [authority]", told);
        }
        let rank_of = |claim: &mut Claim| {
            if let Some(known) = rules.principals.iter().find(|p| p.name == claim.name) {
                (claim.rank, claim.cyclic) = (known.rank, known.cyclic);
            }
            claim.rank = claim.rank.min(rules.ranks.len().saturating_sub(1));
        };
        match &mut self.state {
            State::Held(by, _) | State::Reserved(by, _) => rank_of(by),
            State::Free => {}
        }
        self.last = self.last.take().filter(|last| rules.is_configured(last));
        self.last.iter_mut().for_each(rank_of);
        self.waiting.retain(|waiting| rules.is_configured(&waiting.who));
        let is_known = |stood: &LastStop| rules.principals.iter().any(|p| p.name == stood.name);
        self.stood.retain(is_known);
        self.repeater = None;
    }

    /// Ends the hold for this reason.
    pub fn end(&mut self, why: &str, told: &mut Vec<HoldChange>) {
        self.ends(why, told);
    }

    /// Whether silence of this client must stop the drive, because the client is the holder or was the last one.
    pub(crate) fn is_whose_silence_counts(&self, who: Option<&Claim>) -> bool {
        match &self.last {
            None => true,
            Some(last) => who.is_some_and(|who| who.is(last)),
        }
    }

    /// The holder; `None` once its hold is known to have ended.
    pub fn holder(&self) -> Option<&Arc<str>> {
        match &self.state {
            State::Held(by, _) => Some(&by.name),
            State::Free | State::Reserved(..) => None,
        }
    }

    /// The client whose repeated stops end the holds of others: its principal should be configured as `cyclic`.
    pub(crate) fn repeater(&self) -> Option<&Arc<str>> {
        self.repeater.as_ref()
    }

    /// The present reservation: for whom, and until when.
    pub(crate) fn reservation(&self) -> Option<(&Claim, Instant)> {
        match &self.state {
            State::Reserved(by, until) => Some((by, *until)),
            State::Free | State::Held(..) => None,
        }
    }

    /// A stop before the start of the process reserved the drive.
    pub fn reserve(&mut self, who: Claim, until: Instant) {
        if let State::Free = self.state {
            self.state = State::Reserved(who, until);
        }
    }

    /// Whether the client holds the drive.
    pub(crate) fn is_held_by(&self, who: &Claim, now: Instant) -> bool {
        self.held(now).is_some_and(|(by, _)| by.is(who))
    }

    /// Published state of the hold.
    pub fn view(&self, rules: &Rules, now: Instant) -> HoldView {
        let of = |state: HoldState, (by, left): (&Claim, Duration)| HoldView {
            state,
            holder: Some(by.name.clone()),
            rank: Some(rules.rank(by.rank)),
            left_s: Some(seconds(left)),
        };
        if self.local {
            return HoldView {
                state: HoldState::Local,
                holder: Some("local".into()),
                rank: Some("local".into()),
                left_s: None,
            };
        }
        let held = self.held(now).map(|held| of(HoldState::Held, held));
        let reserved = || self.reserved(now).map(|reserved| of(HoldState::Reserved, reserved));
        held.or_else(reserved).unwrap_or(HoldView {
            state: HoldState::Free,
            holder: None,
            rank: None,
            left_s: Some(0),
        })
    }

    /// The drive acknowledged a stop of that client.
    pub(crate) fn stop_acknowledged(&mut self, who: &Claim) {
        for stood in self.stood.iter_mut().filter(|stood| stood.name == who.name) {
            stood.acknowledged = true;
        }
    }

    fn has_stopped(&self, who: &Claim) -> bool {
        self.stood.iter().any(|stood| stood.name == who.name)
    }

    /// Whether the previous word of this cyclic client was a stop as well.
    pub(crate) fn repeats(&self, who: &Claim) -> bool {
        who.cyclic && self.has_stopped(who)
    }

    fn note_word(&mut self, who: Option<&Claim>, asks: Asks) {
        let Some(who) = who else { return };
        match asks {
            Asks::Stop if !self.has_stopped(who) => {
                // Bounds the table: besides the principals there may be any number of users.
                if self.stood.len() >= MOST_STOOD {
                    self.stood.remove(0);
                }
                self.stood.push(LastStop {
                    name: who.name.clone(),
                    acknowledged: false,
                });
            }
            Asks::Run => self.stood.retain(|stood| stood.name != who.name),
            Asks::Stop | Asks::Steer | Asks::Other | Asks::Nothing => {}
        }
    }
}
