//! Configuration and daemon of drivegate.

pub mod config;
pub mod daemon;

use drivegate_bus as bus;
use drivegate_core::drill;
use drivegate_core::event;
use drivegate_core::files;
use drivegate_core::history;
use drivegate_core::order;
use drivegate_core::parameters;
use drivegate_core::permit;
use drivegate_core::plant;
use drivegate_core::process_image;
use drivegate_core::queue;
use drivegate_core::start_guard;
use drivegate_core::stop_all;
use drivegate_line as line;
use drivegate_model::document;
use drivegate_model::drive;
use drivegate_north as north;
use drivegate_proto as codec;
