//! Path and query of an HTTP request.
//!
//! Input: host and token as they appear in the head of the request.

use std::sync::{Arc, LazyLock};

use arc_swap::ArcSwap;
use drivegate_http::Loopback;
use drivegate_core::plant::Plant;

static SERVER: LazyLock<Loopback> = LazyLock::new(|| {
    let plant = Plant {
        gateway: "fuzz".to_string(),
        stale_after: std::time::Duration::from_secs(1),
        buses: Vec::new(),
        events: Default::default(),
        command_log: Default::default(),
    };
    Loopback::new(Arc::new(ArcSwap::from_pointee(plant))).expect("a server")
});

pub(crate) fn run(data: &[u8]) {
    // Hyper refuses text that is not a valid request target.
    let Some(status) = SERVER.get(data) else { return };
    // 421: the target names another host.
    assert!([200, 400, 404, 421].contains(&status), "{status}");
}
