//! Lines that are real to the operating system: ports, device servers, masters and slaves that were written elsewhere.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "tests may panic"
)]

mod support;

mod line {
    mod closing;
    mod n2;
    mod port;
    mod rfc2217;
    mod rig;
    mod serial;
    mod sim_peers;
    mod slot;
}
