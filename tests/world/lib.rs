//! The parts of the seeded world: the crates below the configuration, each re-exported under its module name. A
//! separate package, so that the optimised build of `make check` leaves out configuration and command line.

pub use drivegate_bacnet as bacnet;
pub use drivegate_bus as bus;
pub use drivegate_core::{
    diagnosis, drill, event, history, order, parameters, permit, plant, process_image, queue, stalls, start_guard,
    stop_all,
};
pub use drivegate_line as line;
pub use drivegate_model::drive;
pub use drivegate_north as north;
pub use drivegate_proto as codec;
pub use drivegate_sim as sim;
