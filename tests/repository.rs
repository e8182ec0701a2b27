//! Everything that ships: every configuration, the documents, the files of the packages.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod support;

mod repository {
    mod config;
    mod documents;
    mod fuzz_seeds;
    mod names;
    mod packages;
    mod packaging;
    mod permission;
    mod rooms;
    mod tools;
    mod words;
}
