//! Helpers for tests of several targets: outside programs and processes, a gateway's site, plants made by hand.
#![allow(dead_code, reason = "each target takes what it needs")]

pub(crate) mod mqtt;
pub(crate) mod process;
pub(crate) mod site;
pub(crate) mod tools;
