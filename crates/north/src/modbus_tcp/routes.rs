//! The drives that a listener serves, by unit id.

use std::sync::Arc;

use arc_swap::ArcSwap;

use crate::plant::{BusHandle, DriveHandle, Plant, SharedPlant};
use crate::stop_all::{Scope, StopAll};

/// Names of the visible buses; `None` for all.
type VisibleBuses = Option<Vec<String>>;

/// The part of the plant that the clients of one listener see.
#[derive(Debug)]
pub(super) struct PlantView {
    plant: SharedPlant,
    stop_all: Arc<StopAll>,
    buses: ArcSwap<VisibleBuses>,
    routes: ArcSwap<Routes>,
}

impl PlantView {
    pub(super) fn new(plant: SharedPlant, stop_all: Arc<StopAll>, buses: Option<Vec<String>>) -> PlantView {
        let buses = Arc::new(buses);
        let routes = ArcSwap::from_pointee(Routes::new(plant.load_full(), stop_all.clone(), buses.clone()));
        PlantView {
            plant,
            stop_all,
            buses: ArcSwap::new(buses),
            routes,
        }
    }

    /// Shows other buses from the next request of each client on.
    pub(super) fn show(&self, buses: Option<Vec<String>>) {
        if **self.buses.load() != buses {
            self.buses.store(Arc::new(buses));
        }
    }

    /// Whether that bus is visible.
    pub(super) fn shows(&self, bus: &str) -> bool {
        let buses = self.buses.load();
        buses
            .as_ref()
            .as_ref()
            .is_none_or(|buses| buses.iter().any(|name| name == bus))
    }

    /// The routes of the current plant; after a reload, the first client that asks rebuilds them for all.
    pub(super) fn routes(&self) -> Arc<Routes> {
        let routes = self.routes.load_full();
        if self.is_current(&routes) {
            return routes;
        }
        let routes = Arc::new(Routes::new(
            self.plant.load_full(),
            self.stop_all.clone(),
            self.buses.load_full(),
        ));
        self.routes.store(routes.clone());
        routes
    }

    pub(super) fn is_current(&self, routes: &Routes) -> bool {
        Arc::ptr_eq(&self.plant.load(), &routes.plant) && Arc::ptr_eq(&self.buses.load(), &routes.buses)
    }
}

/// The drives of one plant by unit id.
#[derive(Debug)]
pub(super) struct Routes {
    pub(super) plant: Arc<Plant>,
    pub(super) stop_all: Arc<StopAll>,
    buses: Arc<VisibleBuses>,
    drives: Vec<DriveHandle>,
    /// Index in `drives`.
    units: Vec<Option<u16>>,
    /// Whether a bus is visible, in the order of the plant.
    visible: Vec<bool>,
}

impl Routes {
    fn new(plant: Arc<Plant>, stop_all: Arc<StopAll>, buses: Arc<VisibleBuses>) -> Routes {
        let is_visible = |name: &String| buses.as_ref().as_ref().is_none_or(|buses| buses.contains(name));
        let drives: Vec<DriveHandle> = plant.drives().filter(|d| is_visible(&d.image.spec.bus)).collect();
        let mut units = vec![None; usize::from(u8::MAX) + 1];
        for (index, drive) in (0u16..).zip(&drives) {
            if let Some(unit) = units.get_mut(usize::from(drive.image.spec.unit)) {
                unit.get_or_insert(index);
            }
        }
        let visible = plant.buses.iter().map(|b| is_visible(&b.image.spec.name)).collect();
        Routes {
            plant,
            stop_all,
            buses,
            drives,
            units,
            visible,
        }
    }

    pub(super) fn drive(&self, unit: u8) -> Option<&DriveHandle> {
        let index = self.units.get(usize::from(unit)).copied().flatten()?;
        self.drives.get(usize::from(index))
    }

    pub(super) fn drives(&self) -> &[DriveHandle] {
        &self.drives
    }

    /// All of these drives, to stop them.
    pub(super) fn scope(&self) -> Scope {
        match &*self.buses {
            Some(buses) => Scope::Buses(buses.clone()),
            None => Scope::Gateway,
        }
    }

    /// The bus at that index of the configuration, if it is visible.
    pub(super) fn bus(&self, index: usize) -> Option<&BusHandle> {
        let visible = self.visible.get(index).copied().unwrap_or_default();
        self.plant.buses.get(index).filter(|_| visible)
    }
}
