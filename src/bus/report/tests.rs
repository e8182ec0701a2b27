//! What a reader on another thread sees while the image changes.

use super::*;
use crate::codec::{LineFormat, Protocol};
use crate::drive::profile::Profiles;
use crate::process_image::{BusSpec, DriveSpec};

fn image(drives: u8) -> Arc<BusImage> {
    let profile = Profiles::built_in().get("vacon-nx").unwrap().clone();
    let drive = |address| {
        let spec = DriveSpec::new(&format!("d{address}"), "b", address, profile.clone());
        Arc::new(DriveImage::new(spec, Duration::from_secs(1)))
    };
    let bus = BusSpec {
        name: "b".to_string(),
        port: "none".to_string(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(38_400, "8N1").unwrap(),
        cycle: Duration::from_millis(10),
        slow_cycle: Duration::from_secs(1),
    };
    Arc::new(BusImage::new(bus, (1..=drives).map(drive).collect()))
}

fn options() -> BusOptions {
    BusOptions {
        response_timeout: Duration::from_millis(100),
        retries: 1,
        silence: Default::default(),
        line: Default::default(),
        mode: Default::default(),
    }
}

/// A reader that saw the bus down found values of its drives good (a motor that runs on a bus that is down).
#[test]
fn whoever_sees_the_bus_down_sees_every_drive_offline() {
    let image = image(200);
    let now = Instant::now();
    let mut report = Report::new(image.clone(), &options(), Events::default(), Default::default(), now);
    for _ in 0..20 {
        report.bus_up(now);
        for index in 0..image.drives.len() {
            report.apply(&News::Online(index), now);
        }
        let looking = image.clone();
        let reader = std::thread::spawn(move || {
            while looking.health().up {
                std::hint::spin_loop();
            }
            let offline = |drive: &&Arc<DriveImage>| matches!(drive.snapshot().link, Link::Offline(_));
            looking.drives.iter().filter(offline).count()
        });
        report.bus_down("unplugged", now);
        assert_eq!(reader.join().unwrap(), image.drives.len());
    }
}

#[test]
fn a_bus_that_goes_down_is_reported_before_its_drives_and_once() {
    let image = image(2);
    let now = Instant::now();
    let events = Events::default();
    let mut report = Report::new(image, &options(), events.clone(), Default::default(), now);
    report.bus_up(now);
    report.apply(&News::Online(0), now);
    report.bus_down("unplugged", now);
    report.bus_down("unplugged", now);
    let kinds: Vec<EventKind> = events.recent().iter().map(|event| event.kind).collect();
    let expected = [
        EventKind::BusUp,
        EventKind::Online,
        EventKind::BusDown,
        EventKind::Offline,
        EventKind::Offline,
    ];
    assert_eq!(kinds, expected, "also a drive of which nothing was heard");
}
