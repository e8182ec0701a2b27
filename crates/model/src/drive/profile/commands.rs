//! Which words and coils of a profile command a drive, and how they are written.

use super::super::control::{Always, Control, ControlItem, OwnWord, Reset, Run, Setting};
use super::super::model::ModelPoint;
use super::raw::Form;
use super::{Point, Profile};
use drivegate_proto::{Protocol, RequestPdu, Table};

impl Profile {
    /// The `[control]` table; `None` if points of one bit each define the commands.
    pub fn control_table(&self) -> Option<&Control> {
        self.control
            .as_ref()
            .filter(|control| control.own_word != OwnWord::Kept)
    }

    /// The `[control]` table equivalent to commands that are points of one bit each.
    pub(in crate::drive) fn control_of_bits(&self) -> Option<Control> {
        let setting = |point: ModelPoint, on: bool| {
            // A run command that no one may give is still recognised as one.
            let is_used = |of: &&Point| of.write || point == ModelPoint::Run;
            let read = self.model_point(point).filter(is_used)?;
            let written = read.write_to.and_then(|to| self.points.get(to));
            let raw = written.unwrap_or(read).raw()?;
            let (bit, invert) = match raw.form {
                Form::Bit { bit, invert } if bit < 16 => (bit, invert),
                _ => return None,
            };
            Some(Setting {
                place: Some(ControlItem::of(raw)),
                mask: 1 << bit,
                value: u16::from(on != invert) << bit,
                once: false,
            })
        };
        let run = setting(ModelPoint::Run, true)?;
        let at = run.place?;
        // A setting within the control word has no separate register.
        let within = |setting: Setting| Setting {
            place: setting.place.filter(|place| *place != at),
            ..setting
        };
        let reset = setting(ModelPoint::FaultReset, true).map(within);
        Some(Control {
            at,
            own_word: OwnWord::Kept,
            always: Always::default(),
            run: Run::One(within(run)),
            stop: within(setting(ModelPoint::Run, false)?),
            also_stop: Vec::new(),
            reverse: setting(ModelPoint::Reverse, true).map(within),
            fault_reset: reset.map(|setting| Reset {
                setting,
                pulse: 2 * self.update_period,
                verified: true,
            }),
            restarts_on_reset: false,
            refresh: None,
            refresh_with_reference: false,
        })
    }

    /// The register to which the run command is written; also read there if the drive allows it.
    pub fn run_place(&self) -> Option<ControlItem> {
        let control = self.control.as_ref().map(Control::run_place);
        control.or_else(|| self.model_point(ModelPoint::Run)?.raw().map(ControlItem::of))
    }

    /// Whether this word, written to this register, is a run command or a stop; `None` if neither.
    pub fn runs_by(&self, table: Table, address: u16, word: u16) -> Option<bool> {
        let (control, place) = (self.control.as_ref()?, ControlItem { table, address });
        let run = control.is_run(place, word).then_some(true);
        run.or(control.is_stop(place, word).then_some(false))
    }

    /// Whether a write of these items is skipped if the drive already has the values, because it stores them in
    /// EEPROM with limited write cycles. On N2 this includes addresses without a point, but never a stop or a
    /// pulse.
    pub fn writes_on_change(&self, table: Table, items: &[(u16, u16)]) -> bool {
        let spared = |address: u16| {
            let covers = |p: &&Point| p.write && p.raw().is_some_and(|raw| raw.covers(table, address));
            let mut points = self.points.iter().filter(covers).peekable();
            match points.peek() {
                Some(_) => points.all(|p| p.on_change),
                None => self.protocols.contains(&Protocol::N2),
            }
        };
        let stops = |(address, value): &(u16, u16)| self.is_stop(table, *address, *value);
        items.iter().all(|(address, _)| spared(*address)) && !items.iter().any(stops)
    }

    /// Whether a register holds settings besides a bit: not the register of the run command, whose other bits no one
    /// else changes unnoticed.
    pub fn is_settings(&self, table: Table, address: u16) -> bool {
        let is_run = self.run_place() == Some(ControlItem { table, address });
        table == Table::Holding && !self.protocols.contains(&Protocol::N2) && !is_run
    }

    /// Whether a write to that table is released afterwards: an analog output of N2.
    pub fn releases(&self, table: Table) -> bool {
        table == Table::Holding && self.n2.release && self.protocols.contains(&Protocol::N2)
    }

    /// The write that stops every drive of the family on a line when it is broadcast: it clears the whole control
    /// word. `None` if the family has no such write.
    pub fn broadcast_stop(&self) -> Option<RequestPdu> {
        let run = self.run_place().filter(|_| self.broadcast_stop)?;
        let pdu = match run.table {
            Table::Coil => self.functions.write_coil(run.address, false),
            Table::Holding => self.functions.write_register(run.address, 0),
            Table::DiscreteInput | Table::Input => return None,
        };
        self.is_stop(run.table, run.address, 0).then_some(pdu)
    }

    /// Whether writing `value` to that register (or coil) clears the run command: a stop.
    pub fn is_stop(&self, table: Table, address: u16, value: u16) -> bool {
        let place = ControlItem { table, address };
        self.control
            .as_ref()
            .is_some_and(|control| control.is_stop(place, value))
    }
}
