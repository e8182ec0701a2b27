//! A small plant for tests: a bus `line1` with NX drives, all of which may be controlled.

pub(crate) use drivegate_testkit::{nx_plant as plant, read_nx as read};
