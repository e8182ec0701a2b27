use super::*;
use std::sync::Arc;

use crate::command::SourceKind;
use crate::process_image::{BusImage, DriveSpec};
use crate::testkit::{STALE_AFTER, bus, bus_spec, image, monitored, nx, up};

/// Buses `a` and `b`, each with a controlled drive in the group `pumps` and a monitored one in none.
fn plant() -> Plant {
    let profile = nx();
    let bus = |name: &str| {
        let drive = |address, access, group: Option<&str>| {
            image(DriveSpec {
                access,
                group: group.map(str::to_string),
                ..monitored(&format!("{name}{address}"), name, address, &profile)
            })
        };
        let drives = vec![
            drive(1, Access::Control, Some("pumps")),
            drive(2, Access::Monitor, None),
        ];
        up(bus(bus_spec(name), drives))
    };
    Plant::new("g", STALE_AFTER, vec![bus("a"), bus("b")])
}

fn waiting(plant: &Plant) -> [usize; 2] {
    [0, 1].map(|bus| plant.buses[bus].queue.lock().len())
}

#[test]
fn an_order_reaches_the_controlled_drives_of_its_scope() {
    let name = |name: &str| name.to_string();
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    for (scope, stops) in [
        (Scope::Gateway, [1, 1]),
        (Scope::Bus(name("a")), [1, 0]),
        (Scope::Buses(vec![name("b")]), [0, 1]),
        (Scope::Group(name("pumps")), [1, 1]),
    ] {
        let (plant, all) = (plant(), StopAll::default());
        let order = all.order(&plant, &scope, &origin, WAIT, now);
        assert!(order.is_ok() && waiting(&plant) == stops, "{scope:?}");
    }
    for (scope, says) in [
        (Scope::Bus(name("c")), "known: a, b"),
        (Scope::Group(name("fans")), "known: pumps"),
    ] {
        let (plant, all) = (plant(), StopAll::default());
        let error = all.order(&plant, &scope, &origin, WAIT, now).unwrap_err();
        assert!(error.to_string().ends_with(says), "{error}");
        assert_eq!(waiting(&plant), [0, 0]);
    }
    let (mut plant, all) = (plant(), StopAll::default());
    plant.buses.truncate(1);
    let monitored = plant.buses[0].image.drives[1].clone();
    let spec = plant.buses[0].image.spec.clone();
    plant.buses[0].image = Arc::new(BusImage::new(spec, vec![monitored]));
    let error = all.order(&plant, &Scope::Gateway, &origin, WAIT, now).unwrap_err();
    assert_eq!(error, NothingToStop::NotControlled);
}

#[test]
fn orders_without_end_are_all_answered() {
    let (plant, all) = (plant(), StopAll::default());
    let (origin, now) = (Origin::new(SourceKind::Http, "alice"), Instant::now());
    let mut orders: Vec<StopOrder> = (0..MOST_ORDERS + 10)
        .map(|_| all.order(&plant, &Scope::Gateway, &origin, WAIT, now).unwrap())
        .collect();
    assert_eq!(waiting(&plant), [1, 1], "they join");
    let answered = orders.iter_mut().filter_map(|order| order.report.try_recv().ok());
    let answered: Vec<StopReport> = answered.collect();
    assert_eq!(answered.len(), 10, "the oldest");
    assert!(answered.iter().all(|report| !report.ok && report.drives.len() == 2));
    assert!(all.look(&plant, now));
    assert!(!all.look(&plant, now + WAIT));
    let left = orders.iter_mut().filter_map(|order| order.report.try_recv().ok());
    assert_eq!(left.count(), MOST_ORDERS);
}
