//! The drives that a listener serves, by unit id.

use std::sync::Arc;
use std::time::Instant;

use arc_swap::ArcSwap;

use crate::register_map::{FIRST, GATEWAY_UNIT, STOP_ALL};
use drivegate_core::plant::{BusHandle, DriveHandle, DriveKey, FormerMachine, NamedBy, Plant, SharedPlant};
use drivegate_core::stop_all::{Scope, StopAll};

/// The part of the plant that the clients of one listener can see.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct View {
    /// Names of the visible buses; `None` for all.
    pub buses: Option<Vec<String>>,
    /// Name of the drive at unit ids 0 and 255, in place of the gateway's own registers.
    pub default_drive: Option<String>,
    /// Layout of the view's registers.
    pub registers: Registers,
}

/// The layout of a drive's registers for clients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Registers {
    /// The common model from 0x8000 on, and the registers of the drive below.
    #[default]
    Model,
    /// The common model from address 0 on, and the drive's own registers from 0x0300 on.
    ModelAtZero,
    /// Only the drive's own registers, 0 to 0xFFFF.
    Raw,
}

/// The meaning of a register address of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum At {
    /// A register of the common model, with its address counted from 0x8000.
    Model(u16),
    /// A register of the drive itself.
    Drive,
    /// The address has no register.
    Nowhere,
}

/// First address of the commands, of the floats and of the drive's own registers in the layout with the common model at 0.
const COMMANDS_AT: u16 = 0x0110;
const FLOATS_AT: u16 = 0x0200;
const DRIVE_AT: u16 = 0x0300;

impl Registers {
    /// Name of this choice where registers are listed.
    pub fn name(self) -> &'static str {
        match self {
            Registers::Model => "model",
            Registers::ModelAtZero => "model at 0",
            Registers::Raw => "raw",
        }
    }

    /// The address at which clients see a register of the common model, which is given by its address from 0x8000 on.
    pub fn of_model(self, address: u16) -> Option<u16> {
        let offset = address.checked_sub(FIRST)?;
        let shown = match self {
            Registers::Model => return Some(address),
            Registers::Raw => return None,
            Registers::ModelAtZero if (STOP_ALL..FLOATS_AT).contains(&offset) => offset + (COMMANDS_AT - STOP_ALL),
            Registers::ModelAtZero => offset,
        };
        (self.of(shown) == At::Model(address)).then_some(shown)
    }

    /// Whether clients see the drive's own registers from `start` on.
    pub fn shows_the_drives(self, start: u16, count: u16) -> bool {
        self.locate(start, count) == At::Drive
    }

    /// The meaning of the registers from `start` on; a span that crosses from one kind into another has none.
    pub(super) fn locate(self, start: u16, count: u16) -> At {
        let last = u32::from(start) + u32::from(count.saturating_sub(1));
        let Ok(last) = u16::try_from(last) else {
            return At::Nowhere;
        };
        let (first, last) = (self.of(start), self.of(last));
        match (first, last) {
            (At::Model(first), At::Model(last)) if last.wrapping_sub(first) == count.saturating_sub(1) => {
                At::Model(first)
            }
            (At::Drive, At::Drive) => At::Drive,
            _ => At::Nowhere,
        }
    }

    /// Start address of a write that crosses from one kind of registers into another and covers the command word,
    /// as if all of it belonged to the common model. A stop in such a write is carried out, however far the write
    /// extends.
    pub(super) fn around_the_command_word(self, start: u16, count: u16) -> Option<u16> {
        let word = match self {
            Registers::Model => FIRST + STOP_ALL,
            Registers::ModelAtZero => COMMANDS_AT,
            Registers::Raw => return None,
        };
        let covers = start <= word && u32::from(word) < u32::from(start) + u32::from(count);
        covers.then(|| FIRST + STOP_ALL - (word - start))
    }

    fn of(self, address: u16) -> At {
        match self {
            Registers::Raw => At::Drive,
            Registers::Model if address >= FIRST => At::Model(address),
            Registers::Model => At::Drive,
            Registers::ModelAtZero => match address {
                ..STOP_ALL => At::Model(FIRST + address),
                STOP_ALL..COMMANDS_AT => At::Nowhere,
                COMMANDS_AT..FLOATS_AT => At::Model(FIRST + STOP_ALL + (address - COMMANDS_AT)),
                FLOATS_AT..DRIVE_AT => At::Model(FIRST + address),
                DRIVE_AT..FIRST => At::Drive,
                FIRST.. => At::Nowhere,
            },
        }
    }
}

/// A view, and the last one under which a unit id or an address meant something else.
#[derive(Debug)]
struct Shown {
    view: View,
    before: Option<EarlierView>,
}

/// A view that clients had until `until`.
#[derive(Debug, Clone)]
struct EarlierView {
    view: View,
    /// Since when clients had it; `None` if it was the first one.
    since: Option<Instant>,
    until: Instant,
}

/// What a unit id meant when a request began, if a reload has changed that or the place of the registers since.
#[derive(Debug)]
pub(super) struct EarlierUnit {
    /// The machine, if a bus still serves it.
    pub(super) drive: Option<DriveHandle>,
    /// Where the registers were.
    pub(super) registers: Registers,
    /// Whether the unit id meant the drive as that of `default_drive`.
    pub(super) is_default: bool,
}

/// The part of the plant that the clients of one listener can see.
#[derive(Debug)]
pub(super) struct PlantView {
    /// Number of the listener.
    pub(super) number: usize,
    plant: SharedPlant,
    stop_all: Arc<StopAll>,
    shown: ArcSwap<Shown>,
    routes: ArcSwap<Routes>,
}

impl PlantView {
    pub(super) fn new(number: usize, plant: SharedPlant, stop_all: Arc<StopAll>, view: View) -> PlantView {
        let shown = Arc::new(Shown { view, before: None });
        let routes = ArcSwap::from_pointee(Routes::new(plant.load_full(), stop_all.clone(), shown.clone()));
        PlantView {
            number,
            plant,
            stop_all,
            shown: ArcSwap::new(shown),
            routes,
        }
    }

    /// Shows another view from the next request of each client on, at `now`.
    pub(super) fn show(&self, view: View, now: Instant) {
        let before = self.shown.load();
        if before.view == view {
            return;
        }
        let moved = (&before.view.default_drive, before.view.registers) != (&view.default_drive, view.registers);
        let earlier = if moved {
            Some(EarlierView {
                view: before.view.clone(),
                since: before.before.as_ref().map(|earlier| earlier.until),
                until: now,
            })
        } else {
            before.before.clone()
        };
        self.shown.store(Arc::new(Shown { view, before: earlier }));
    }

    /// Whether a bus is visible.
    pub(super) fn shows(&self, bus: &str) -> bool {
        self.shown.load().view.has(bus)
    }

    /// The routes of the current plant; after a reload, the first client with a request rebuilds them for all.
    pub(super) fn routes(&self) -> Arc<Routes> {
        let routes = self.routes.load_full();
        if self.is_current(&routes) {
            return routes;
        }
        let routes = Arc::new(Routes::new(
            self.plant.load_full(),
            self.stop_all.clone(),
            self.shown.load_full(),
        ));
        self.routes.store(routes.clone());
        routes
    }

    pub(super) fn is_current(&self, routes: &Routes) -> bool {
        Arc::ptr_eq(&self.plant.load(), &routes.plant) && Arc::ptr_eq(&self.shown.load(), &routes.shown)
    }
}

impl View {
    fn has(&self, bus: &str) -> bool {
        self.buses
            .as_ref()
            .is_none_or(|buses| buses.iter().any(|name| name == bus))
    }
}

/// The drives of one plant by unit id.
#[derive(Debug)]
pub(super) struct Routes {
    pub(super) plant: Arc<Plant>,
    pub(super) stop_all: Arc<StopAll>,
    shown: Arc<Shown>,
    drives: Vec<DriveHandle>,
    /// Index in `drives` for each unit id.
    units: Vec<Option<u16>>,
    /// Whether a bus is visible, in the order of the plant.
    visible: Vec<bool>,
}

impl Routes {
    fn new(plant: Arc<Plant>, stop_all: Arc<StopAll>, shown: Arc<Shown>) -> Routes {
        let view = &shown.view;
        let drives: Vec<DriveHandle> = plant.drives().filter(|d| view.has(&d.image.spec.bus)).collect();
        let mut units = vec![None; usize::from(u8::MAX) + 1];
        for (index, drive) in (0u16..).zip(&drives) {
            let spec = &drive.image.spec;
            let is_default = view.default_drive.as_ref() == Some(&spec.name);
            let more = [0, GATEWAY_UNIT].into_iter().filter(|_| is_default);
            for unit in more.chain([spec.unit]) {
                if let Some(unit) = units.get_mut(usize::from(unit)) {
                    unit.get_or_insert(index);
                }
            }
        }
        let visible = plant.buses.iter().map(|b| view.has(&b.image.spec.name)).collect();
        Routes {
            plant,
            stop_all,
            shown,
            drives,
            units,
            visible,
        }
    }

    pub(super) fn drive(&self, unit: u8) -> Option<&DriveHandle> {
        let index = self.units.get(usize::from(unit)).copied().flatten()?;
        self.drives.get(usize::from(index))
    }

    /// The layout of the registers of drives.
    pub(super) fn registers(&self) -> Registers {
        self.shown.view.registers
    }

    /// Whether units 0 and 255 are a drive.
    pub(super) fn has_default_drive(&self) -> bool {
        self.shown.view.default_drive.is_some()
    }

    /// What the unit id meant at `asked`; `None` if it means now what it meant then.
    pub(super) fn meaning_at(&self, unit: u8, asked: Instant) -> Option<EarlierUnit> {
        let earlier = self.shown.before.as_ref().filter(|earlier| asked < earlier.until);
        let view = earlier.map_or(&self.shown.view, |earlier| &earlier.view);
        let of_default = [0, GATEWAY_UNIT].contains(&unit);
        let default = view.default_drive.as_ref().filter(|_| of_default);
        let (key, by) = match default {
            Some(name) => (DriveKey::Name(name.clone()), NamedBy::Name),
            None => (DriveKey::Unit(unit), NamedBy::Unit),
        };
        let now = match default {
            Some(name) => self.plant.drive(name),
            None => self.drives.iter().find(|drive| drive.image.spec.unit == unit).cloned(),
        };
        let drive = match now {
            Some(drive) => match drive.former(by, asked) {
                None if earlier.is_none() => return None,
                None => Some(drive),
                Some(FormerMachine::There(there)) => Some(*there),
                Some(FormerMachine::Gone) => None,
            },
            None => match self.plant.drive_formerly(&key, asked) {
                None if earlier.is_none() => return None,
                had => had,
            },
        };
        // Two changes of the view since the request began leave its meaning unknown.
        let is_known = earlier
            .and_then(|earlier| earlier.since)
            .is_none_or(|since| since <= asked);
        Some(EarlierUnit {
            drive: drive.filter(|_| is_known),
            registers: view.registers,
            is_default: default.is_some(),
        })
    }

    pub(super) fn drives(&self) -> &[DriveHandle] {
        &self.drives
    }

    /// All visible drives, as the scope of stop all.
    pub(super) fn scope(&self) -> Scope {
        match &self.shown.view.buses {
            Some(buses) => Scope::Buses(buses.clone()),
            None => Scope::Gateway,
        }
    }

    /// The bus with this index in the configuration, if that bus is visible.
    pub(super) fn bus(&self, index: usize) -> Option<&BusHandle> {
        let visible = self.visible.get(index).copied().unwrap_or_default();
        self.plant.buses.get(index).filter(|_| visible)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn where_registers_are() {
        use At::{Drive, Model, Nowhere};
        for (registers, start, count, expected) in [
            (Registers::Model, 0x8000, 19, Model(0x8000)),
            (Registers::Model, 0x7FFF, 1, Drive),
            (Registers::Model, 0x7FFF, 2, Nowhere),
            (Registers::Raw, 0xFA00, 1, Drive),
            (Registers::Raw, 0xFFFF, 1, Drive),
            (Registers::Raw, 0xFFFF, 2, Nowhere),
            (Registers::ModelAtZero, 0, 19, Model(0x8000)),
            (Registers::ModelAtZero, 0x00FF, 2, Nowhere),
            (Registers::ModelAtZero, 0x0100, 1, Nowhere),
            (Registers::ModelAtZero, 0x010F, 2, Nowhere),
            (Registers::ModelAtZero, 0x0110, 4, Model(0x8100)),
            (Registers::ModelAtZero, 0x0200, 2, Model(0x8200)),
            (Registers::ModelAtZero, 0x02FF, 2, Nowhere),
            (Registers::ModelAtZero, 0x0300, 10, Drive),
            (Registers::ModelAtZero, 0x7FFF, 1, Drive),
            (Registers::ModelAtZero, 0x8000, 1, Nowhere),
        ] {
            assert_eq!(
                registers.locate(start, count),
                expected,
                "{registers:?} {start:#x} {count}"
            );
        }
        let around = |start, count| Registers::ModelAtZero.around_the_command_word(start, count);
        assert_eq!((around(0x0100, 17), around(0x0100, 16)), (Some(0x80F0), None));
        assert_eq!((around(0x0110, 123), around(0x0111, 9)), (Some(0x8100), None));
    }

    #[test]
    fn every_register_of_the_model_is_found_where_it_is_listed() {
        for registers in [Registers::Model, Registers::ModelAtZero, Registers::Raw] {
            let mut listed = 0;
            for address in FIRST..=FIRST + 0x2FF {
                if let Some(shown) = registers.of_model(address) {
                    assert_eq!(registers.locate(shown, 1), At::Model(address), "{registers:?}");
                    listed += 1;
                }
            }
            let seen = (0..=u16::MAX).filter(|shown| matches!(registers.locate(*shown, 1), At::Model(FIRST..=0x82FF)));
            assert_eq!(listed, seen.count(), "{registers:?}");
        }
        assert_eq!(Registers::ModelAtZero.of_model(0x8100), Some(0x0110));
        assert!(!Registers::ModelAtZero.shows_the_drives(0x02FF, 2));
        assert!(Registers::Raw.shows_the_drives(0xFFFF, 1) && !Registers::Model.shows_the_drives(0x7FFF, 2));
    }
}
