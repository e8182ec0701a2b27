//! What stands in for the outside world in the demo, in `simulate`, in tests and in benches.

pub mod broker;
