//! Helpers for tests of several targets: external programs and processes, a gateway's site, plants that tests set up.
#![allow(dead_code, reason = "each target takes what it needs")]

pub(crate) mod mqtt;
pub(crate) mod process;
pub(crate) mod site;
pub(crate) mod tools;
