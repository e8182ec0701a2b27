//! The direction of the next start: kept where a motor that stands has no word for it. Pure.

use super::steps::Action;
use super::word::Word;
use super::{CommandRun, KnownWords, Shown};
use drivegate_core::order::{Order, Urgency, written};
use drivegate_model::drive::control::Run;
use drivegate_model::drive::{ModelPoint, Profile};
use drivegate_proto::Table;

/// Effect of a command on the direction that is kept for the next start.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NextDirection {
    Unchanged,
    /// The command sets the direction, or starts the motor: a kept direction is dropped.
    Dropped,
    /// The direction that the command orders is kept, because no word of the family has it while the motor stands.
    Kept(bool),
}

impl NextDirection {
    /// Effect of an order of this rank, as far as the order itself decides it.
    pub(super) fn of(profile: &Profile, order: &Order, urgency: Urgency) -> NextDirection {
        let of_stop = direction_at_stop(profile, order).filter(|_| urgency == Urgency::Stop);
        match of_stop {
            Some(reverse) => NextDirection::Kept(reverse),
            None if starts_or_sets_direction(profile, order) => NextDirection::Dropped,
            None => NextDirection::Unchanged,
        }
    }
}

impl CommandRun {
    /// Keeps the direction for the next start and leaves out its write.
    pub(super) fn keep_direction(&mut self, reverse: bool) {
        if self.in_doubt() {
            self.give_up(self.tries.unanswered.clone());
            return;
        }
        let elsewhere = matches!(self.actions.front(), Some(Action::Word(Word::DirectionElsewhere(_))));
        self.pop();
        if elsewhere {
            self.pop();
        }
        if matches!(self.actions.front(), Some(Action::Release(_))) {
            self.pop();
        }
        self.look.forget();
        self.next_direction = NextDirection::Kept(reverse);
        // The effects of the rest of the command would be taken for the effect of the direction.
        self.shown = Shown::AtNextStart;
    }

    /// Keeps the direction that the command ordered; if it set another one, drops the kept one.
    pub(crate) fn note_direction(&self, words: &mut KnownWords) {
        match self.next_direction {
            NextDirection::Kept(reverse) => words.keep_direction(reverse),
            NextDirection::Dropped => words.forget_direction(),
            NextDirection::Unchanged => {}
        }
    }

    /// Whether the direction that the command orders waits for the next start.
    #[cfg(test)]
    pub(crate) fn waits_for_start(&self) -> bool {
        matches!(self.shown, Shown::AtNextStart)
    }
}

/// Whether an order is a run command that names no direction.
pub(crate) fn names_no_direction(profile: &Profile, order: &Order) -> bool {
    let Order::Points(values) = order else {
        return false;
    };
    let named = |point: ModelPoint| {
        let index = profile.model_index(point)?;
        let written = profile.points.get(index)?.write_to.unwrap_or(index);
        let mut values = values.iter();
        values.find(|(of, _)| *of == written).map(|(_, value)| value.as_bool())
    };
    named(ModelPoint::Run) == Some(true) && named(ModelPoint::Reverse).is_none()
}

/// The direction that an order names, where the family has it in its run commands only.
fn direction_at_stop(profile: &Profile, order: &Order) -> Option<bool> {
    let control = profile.control.as_ref()?;
    let (Order::Points(values), Run::Pair { .. }) = (order, &control.run) else {
        return None;
    };
    let index = profile.model_index(ModelPoint::Reverse)?;
    let written = profile.points.get(index)?.write_to.unwrap_or(index);
    let mut values = values.iter();
    values.find(|(of, _)| *of == written).map(|(_, value)| value.as_bool())
}

/// Whether an order sets the direction or starts the motor. A raw write to one of the places of these commands
/// counts as well.
fn starts_or_sets_direction(profile: &Profile, order: &Order) -> bool {
    match order {
        Order::Points(values) => {
            let says = |point: ModelPoint, on: Option<bool>| {
                let index = profile.model_index(point);
                let written = index.and_then(|index| profile.points.get(index)?.write_to).or(index);
                values
                    .iter()
                    .any(|(of, value)| Some(*of) == written && on.is_none_or(|on| value.as_bool() == on))
            };
            says(ModelPoint::Reverse, None) || says(ModelPoint::Run, Some(true))
        }
        Order::Write(pdu) => {
            let control = profile.control.as_ref();
            let places = control.map(|control| {
                let reverse = control.reverse.and_then(|setting| setting.place);
                [Some(control.at), Some(control.run_place()), reverse]
            });
            let reaches = |table: Table, address: u16| {
                let places = places.into_iter().flatten().flatten();
                places
                    .into_iter()
                    .any(|place| (place.table, place.address) == (table, address))
            };
            written(pdu).is_none_or(|(table, items)| items.iter().any(|(address, _)| reaches(table, *address)))
        }
        Order::Read(_) | Order::Parameter(_) => false,
    }
}
