//! A user profile with any content.
//!
//! Input: the file; bytes that are not UTF-8 are replaced.

use drivegate_model::drive::Profile;

pub(crate) fn run(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    match Profile::parse("fuzz.toml", &text, false) {
        Err(problems) => assert!(problems.iter().all(|problem| !problem.to_string().is_empty()) && !problems.is_empty()),
        Ok(profile) => {
            assert!(!profile.name.is_empty());
            assert!(profile.points.iter().all(|point| profile.point_index(&point.name).is_some()));
        }
    }
}
