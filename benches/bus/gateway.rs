//! The whole gateway as a master on the simulated line, while its servers are read by clients.

use std::error::Error;
use std::time::Duration;

use drivegate_proto::LineFormat;
use drivegate_sim::statistics::Statistics;
use drivegate_sim::wire::SimulatedBus;

use crate::common::gateway::{Bus, Gateway, NORTH, settings};
use crate::{DRIVES, record};

/// A profile with the registers that the bare master reads, and no others.
const PROFILE: &str = "name = \"process-data\"\nprotocols = [\"modbus-rtu\"]\n\
    [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\nholes = true\n\
    [[point]]\nname = \"fault\"\nat = \"holding 2100.3\"\nclass = \"fast\"\n\
    [[point]]\nname = \"fault_code\"\nat = \"holding 2110\"\nclass = \"fast\"\n";

/// Runs the gateway for `time` after all drives answered; the counters of the line before that time.
pub(crate) fn run(line: &SimulatedBus, format: LineFormat, time: Duration) -> Result<Statistics, Box<dyn Error>> {
    let profiles = tempfile::tempdir()?;
    std::fs::write(profiles.path().join("process-data.toml"), PROFILE)?;
    let bus = Bus {
        name: "line",
        port: &line.address(),
        baud: format.baud,
        drives: *DRIVES.end(),
        profile: "process-data",
        keys: "",
        drive_keys: "turnaround = \"0.5ms\"",
    };
    let folder = profiles.path().display();
    let gateway = Gateway::start(settings(&format!(
        "profile_dirs = [\"{folder}\"]\n{}{NORTH}",
        bus.toml()
    ))?)?;
    let readers = gateway.read()?;
    let before = record(line, time, format);
    std::thread::sleep(time);
    gateway.stop();
    readers.stop()?;
    Ok(before)
}
