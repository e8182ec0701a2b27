//! Process data that does not hold the value of its profile: the comparisons of [`crate::selection`] applied to the
//! image.

use std::time::Instant;

use super::{Findings, RECENT, Report};
use drivegate_core::event::EventKind;
use drivegate_core::process_image::DriveImage;
use drivegate_model::drive::{DriveIndex, PlannedRead, PointIndex};
use drivegate_proto::Exception;

impl Report {
    /// Compares the values that were just read. Returns the monitoring points to read: drive, point and time.
    pub(super) fn compare_selection(
        &mut self,
        index: DriveIndex,
        drive: &DriveImage,
        read: &PlannedRead,
        words: &[u16],
        at: Instant,
    ) -> Vec<(DriveIndex, PointIndex, Instant)> {
        if !self.selections.are_concerned_by(index, read, words, at) {
            return Vec::new();
        }
        let findings = self.selections.read(index, read, words, &drive.reading(at, RECENT));
        let wanted = findings.reads.iter().map(|(point, at)| (index, *point, *at));
        let wanted = wanted.collect();
        self.selection_found(drive, index, &findings);
        wanted
    }

    /// Notes that the drive has no such monitoring register: its process data is then used as it is.
    pub(super) fn monitor_refused(
        &mut self,
        index: DriveIndex,
        drive: &DriveImage,
        read: &PlannedRead,
        exception: Exception,
        now: Instant,
    ) {
        tracing::debug!(
            target: "drivegate::bus::report", bus = %self.image.spec.name, drive = %drive.spec.name,
            "the drive refuses {} {} with {exception}; process data is not compared with it",
            read.table, read.start
        );
        let findings = self.selections.refused(index, read, &drive.reading(now, RECENT), now);
        self.selection_found(drive, index, &findings);
    }

    fn selection_found(&mut self, drive: &DriveImage, index: DriveIndex, findings: &Findings) {
        if let Some(monitored) = &findings.monitored {
            drive.update(|snapshot| snapshot.monitored.clone_from(monitored));
        }
        let points = &drive.spec.profile.points;
        let name = |point: PointIndex| points.get(point).map_or("", |point| &point.name);
        for point in &findings.restored {
            tracing::info!(
                target: "drivegate::bus::report", bus = %self.image.spec.name, drive = %drive.spec.name,
                "process data holds {} again; the value comes from there", name(*point)
            );
        }
        let differ = |(point, own, monitored): &(PointIndex, f64, f64)| {
            format!(
                "{} reads {own} there and {monitored} in its monitoring register",
                name(*point)
            )
        };
        let differ: Vec<String> = findings.differ.iter().map(differ).collect();
        if differ.is_empty() {
            return;
        }
        let text = format!(
            "process data of drive {} does not match profile `{}`: {}; the monitoring register is used; restore the \
             process data selection in the drive, or describe it in a profile of your own",
            drive.spec.name,
            drive.spec.profile.name,
            differ.join(", ")
        );
        if self.selections.report_first(index) {
            self.drive_event(index, EventKind::SelectionDiffers, None, |_| text)
        } else {
            tracing::warn!(target: "drivegate::bus::report", bus = %self.image.spec.name, "{text}")
        }
    }
}
