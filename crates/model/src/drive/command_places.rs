//! The registers and coils by which a drive is commanded: only its commands may write to them.

use super::control::{Control, ControlItem, OwnWord, Run, Setting};
use super::profile::Form;
use super::{ModelPoint, PointIndex, Profile};
use drivegate_proto::Table;

impl Control {
    /// All settings that commands write, including the steps to a run command.
    fn settings(&self) -> impl Iterator<Item = Setting> {
        let steps = match &self.run {
            Run::Steps(steps) => steps.iter().map(|step| step.write).collect(),
            Run::One(_) | Run::Pair { .. } => self.runs(),
        };
        let reset = self.fault_reset.map(|reset| reset.setting);
        steps.into_iter().chain([self.stop]).chain(self.reverse).chain(reset)
    }

    /// Whether commands are written to this register or coil.
    fn is_place(&self, place: ControlItem) -> bool {
        place == self.at || self.settings().any(|setting| setting.place == Some(place))
    }

    /// Whether a command sets one of these bits in this register or coil.
    fn sets(&self, place: ControlItem, bits: u16) -> bool {
        self.settings()
            .any(|setting| setting.place.unwrap_or(self.at) == place && setting.mask & bits != 0)
    }
}

impl Profile {
    /// Whether writing this point changes a register of the commands although the point is not a command: that
    /// could start the motor and evade every rule for starts. A point with its own bits in a word whose other bits
    /// are kept does not.
    pub fn is_past_commands(&self, index: PointIndex) -> bool {
        let Some(control) = &self.control else { return false };
        let own = [ModelPoint::Run, ModelPoint::Reverse, ModelPoint::FaultReset];
        let is_own = own.into_iter().any(|point| self.model_index(point) == Some(index));
        let Some(raw) = self.points.get(index).and_then(|point| point.raw()).filter(|_| !is_own) else {
            return false;
        };
        let mut places = control
            .settings()
            .filter_map(|setting| setting.place)
            .chain([control.at]);
        places.any(|place| {
            let shares = match raw.form {
                Form::Bit { bit, .. } if control.own_word == OwnWord::Kept => control.sets(place, 1u16 << bit.min(15)),
                _ => true,
            };
            shares && raw.covers(place.table, place.address)
        })
    }

    /// Whether these holding registers have one to which a command is written.
    pub fn commands_in(&self, first: u16, count: u16) -> bool {
        let Some(control) = &self.control else { return false };
        let mut addresses = (first..).take(usize::from(count));
        addresses.any(|address| {
            control.is_place(ControlItem {
                table: Table::Holding,
                address,
            })
        })
    }
}
