//! What ships: every configuration, the documents, what is packaged around the program.
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
    mod packages;
    mod packaging;
    mod permission;
    mod rooms;
    mod tools;
    mod words;
}
