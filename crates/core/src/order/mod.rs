//! Orders on their way in: when each came and over which connection, and how long the threads that read them stood
//! still. Pure, except for the heartbeats of those threads.

mod arrival;
mod last_stops;
mod pauses;
mod stalls;

pub use arrival::{Arrival, Connection};
pub use last_stops::LastStops;
pub use pauses::{Heartbeat, Pauses};
pub use stalls::{Dated, READ_WITHIN, Stall, Stalls, Stood, TICK, UNNOTICED};
