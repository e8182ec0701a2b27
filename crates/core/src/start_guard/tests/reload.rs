//! Changes of the guards by a reload, and their limits.

use super::*;

const STAGGERED: Guard = Guard {
    starts_per_hour: None,
    min_off: Duration::ZERO,
    min_run: Duration::ZERO,
    stagger: Duration::from_secs(5),
};

fn trip(drive: &str) -> Interlock {
    Interlock {
        drive: drive.to_string(),
        point: "running".to_string(),
        is: true,
        trip: true,
    }
}

impl GuardedDrives {
    /// The drives as on a bus that is prepared for a reload.
    fn prepared(&self, change: impl Fn(&mut DriveSpec)) -> Arc<BusGuards> {
        let mut specs: Vec<DriveSpec> = self.images.iter().map(|image| image.spec.clone()).collect();
        specs.iter_mut().for_each(change);
        BusGuards::of(&self.shared, &self.bus, &specs).unwrap()
    }

    /// Restarts the bus of these drives: the bus ends and begins at these times.
    fn restart(&mut self, drives: &[usize], ends: f64, begins: f64) {
        let leaving: Vec<Arc<DriveImage>> = drives.iter().map(|drive| self.images[*drive].clone()).collect();
        self.shared.expect(&leaving, self.at(ends));
        for drive in drives {
            self.images[*drive] = image(self.images[*drive].spec.clone());
        }
        self.watch(self.at(begins));
    }

    fn tripped(&self, drive: usize, seconds: f64) -> Option<String> {
        let unmet = self.guards.tripped(DriveIndex::new(drive), None, self.at(seconds));
        unmet.first().map(ToString::to_string)
    }
}

#[test]
fn a_prepared_bus_changes_nothing_until_it_begins() {
    let rig = GuardedDrives::of(STAGGERED, Vec::new());
    (0..3).for_each(|drive| rig.read(drive, false, 0.0));
    // In the prepared bus each drive has a separate group.
    let prepared = rig.prepared(|spec| spec.group = Some(spec.name.clone()));
    rig.start_and_stop(0, 1, 1.0);
    assert_eq!(rig.refused(1, 2.0), Some("stagger"), "guarded as before");
    prepared.begin();
    let refused = |seconds| {
        let verdict = judged(&prepared, Stage::Accept, &[1], (0, None), rig.at(seconds));
        matches!(verdict, Verdict::Refuse(_)).then_some(verdict)
    };
    assert_eq!(refused(2.0), None, "another group");
    // Back in the old groups, a start made meanwhile counts in the group of its drive.
    rig.guards.begin();
    assert_eq!((rig.refused(1, 5.9), rig.refused(1, 6.0)), (Some("stagger"), None));
}

#[test]
fn a_drive_whose_bus_is_started_anew_counts_for_trips_as_it_counted_before() {
    let mut rig = GuardedDrives::of(Guard::default(), vec![trip("d3")]);
    // After the start of the process, a point without a reading does not stop the drive for the first 10 s.
    assert_eq!(rig.tripped(0, 9.9), None);
    assert!(rig.tripped(0, 10.0).is_some_and(|why| why.contains("is unknown")));
    rig.read(2, true, 20.0);
    assert_eq!(rig.tripped(0, 20.9), None);
    // The bus needs longer to end than its values stay fresh, and reads once more meanwhile.
    let leaving = vec![rig.images[2].clone()];
    rig.shared.expect(&leaving, rig.at(20.5));
    rig.read(2, true, 20.6);
    assert_eq!((rig.tripped(0, 22.5), rig.tripped(0, 30.4)), (None, None));
    rig.restart(&[2], 20.5, 23.0);
    assert_eq!(rig.tripped(0, 30.4), None, "it held");
    assert!(rig.refused(0, 23.0) == Some("interlock"), "starts need a reading");
    assert!(rig.tripped(0, 30.5).is_some(), "ten seconds at most");
    // The first reading after the restart decides.
    rig.read(2, false, 24.0);
    assert!(rig.tripped(0, 24.1).is_some_and(|why| why.contains("but is false")));
    // The bus restarts again while the interlock does not hold.
    rig.restart(&[2], 24.5, 24.6);
    assert!(rig.tripped(0, 24.7).is_some_and(|why| why.contains("but is false")));
    rig.read(2, true, 25.0);
    assert_eq!(rig.tripped(0, 25.1), None);
    // The bus restarts twice before the drive is read.
    rig.restart(&[2], 25.5, 25.6);
    rig.restart(&[2], 27.0, 27.1);
    assert_eq!(rig.tripped(0, 35.4), None);
    assert!(rig.tripped(0, 35.6).is_some(), "ten seconds from the first");
}

#[test]
fn a_drive_that_was_not_there_stops_no_motor_before_it_was_read() {
    let mut rig = GuardedDrives::of(Guard::default(), vec![trip("d3")]);
    rig.read(2, true, 0.0);
    // Another machine has taken the name of the drive.
    let mut spec = rig.images[2].spec.clone();
    spec.address = 9;
    rig.images[2] = image(spec);
    rig.watch(rig.at(5.0));
    assert_eq!(rig.tripped(0, 14.9), None);
    assert!(rig.tripped(0, 15.0).is_some());
}
