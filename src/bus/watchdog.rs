//! What a drive does by itself when its master falls silent, as far as its registers tell. Pure.

use crate::cache::Reading;
use crate::drive::{COMMUNICATION_TIMEOUT, FIELDBUS_FAULT_RESPONSE};

/// The points that tell it; 0 in any of them is no response.
const POINTS: [&str; 2] = [FIELDBUS_FAULT_RESPONSE, COMMUNICATION_TIMEOUT];

/// A drive's own response to a silent master.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OwnResponse {
    /// Not read yet, or the profile knows no point for it.
    Unknown,
    /// It has none: the point that says so.
    Off(&'static str),
    /// It responds, if what no register tells is set too (such as the timeout of an option board).
    On,
}

/// The drive's own response.
pub(super) fn own_response(reading: &Reading<'_>) -> OwnResponse {
    let mut seen = OwnResponse::Unknown;
    for name in POINTS {
        let Some(point) = reading.spec.profile.point_index(name) else {
            continue;
        };
        let Some(value) = reading.sample(point).good() else {
            return OwnResponse::Unknown;
        };
        if value.as_f64() == 0.0 {
            return OwnResponse::Off(name);
        }
        seen = OwnResponse::On;
    }
    seen
}

#[cfg(test)]
mod tests {

    use std::sync::Arc;
    use std::time::{Duration, Instant, SystemTime};

    use super::*;
    use crate::cache::{Access, DriveImage, DriveSpec, Link};
    use crate::codec::Table;
    use crate::drive::Profile;

    const START: &str = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n\
        [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 999\nread = 30\n";

    fn drive(points: &str) -> DriveImage {
        let spec = DriveSpec {
            access: Access::Control,
            turnaround: Duration::ZERO,
            ..DriveSpec::new(
                "d",
                "b",
                1,
                Arc::new(Profile::parse("p.toml", &format!("{START}{points}"), false).unwrap()),
            )
        };
        let image = DriveImage::new(spec, Duration::from_secs(1));
        image.update(|s| s.link = Link::Online(SystemTime::now()));
        image
    }

    fn told(drive: &DriveImage, words: &[(u16, u16)]) -> OwnResponse {
        let now = Instant::now();
        for (address, word) in words {
            drive.update(|s| s.store(Table::Holding, *address, &[*word], now));
        }
        own_response(&drive.reading(now, Duration::from_secs(1)))
    }

    #[test]
    fn what_the_points_tell_together() {
        let response = "[[point]]\nname = \"fieldbus_fault_response\"\nat = \"holding 732\"\nclass = \"once\"\n";
        let timeout = "[[point]]\nname = \"communication_timeout\"\nat = \"holding 542\"\nscale = 0.1\nunit = \"s\"\nclass = \"once\"\n";
        let other = "[[point]]\nname = \"other\"\nat = \"holding 7\"\nclass = \"once\"\n";
        assert_eq!(told(&drive(other), &[(7, 0)]), OwnResponse::Unknown);
        let one = drive(response);
        assert_eq!(told(&one, &[]), OwnResponse::Unknown, "not read yet");
        assert_eq!(told(&one, &[(732, 0)]), OwnResponse::Off(FIELDBUS_FAULT_RESPONSE));
        assert_eq!(told(&one, &[(732, 2)]), OwnResponse::On);
        let both = drive(&format!("{response}{timeout}"));
        assert_eq!(told(&both, &[(732, 2)]), OwnResponse::Unknown);
        assert_eq!(told(&both, &[(542, 0)]), OwnResponse::Off(COMMUNICATION_TIMEOUT));
        assert_eq!(told(&both, &[(542, 50)]), OwnResponse::On);
    }
}
