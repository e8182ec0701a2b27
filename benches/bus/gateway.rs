//! The whole gateway as a master on the simulated line, its north sides being read.

use std::error::Error;
use std::path::Path;
use std::time::{Duration, Instant};

use drivegate::codec::LineFormat;
use drivegate::config::Settings;
use drivegate::daemon::Daemon;
use drivegate::sim::statistics::Statistics;
use drivegate::sim::wire::SimulatedBus;

use super::common::{Readers, TENTH};
use super::{DRIVES, record};

/// What the bare master reads, and nothing else.
const PROFILE: &str = "name = \"process-data\"\nprotocols = [\"modbus-rtu\"]\n\
    [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 20\nholes = true\n\
    [[point]]\nname = \"fault\"\nat = \"holding 2100.3\"\nclass = \"fast\"\n\
    [[point]]\nname = \"fault_code\"\nat = \"holding 2110\"\nclass = \"fast\"\n";

/// Runs the gateway for `time` after all drives answered; the counters of the line before that time.
pub(super) fn run(line: &SimulatedBus, format: LineFormat, time: Duration) -> Result<Statistics, Box<dyn Error>> {
    let profiles = tempfile::tempdir()?;
    std::fs::write(profiles.path().join("process-data.toml"), PROFILE)?;
    let source = configuration(&line.address(), format.baud, profiles.path());
    let loaded = Settings::parse("bench.toml", &source, std::iter::empty());
    let settings = loaded.settings.ok_or_else(|| format!("{:?}", loaded.errors))?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()?;
    let daemon = runtime.block_on(Daemon::start(settings))?;
    let modbus = daemon.modbus_tcp_addresses().first().copied();
    let plant = daemon.plant().load_full();
    let bus = plant.buses.first().ok_or("no bus")?.image.clone();
    let patience = Instant::now() + Duration::from_secs(20);
    while bus.online() < DRIVES.count() && Instant::now() < patience {
        std::thread::sleep(Duration::from_millis(10));
    }
    let readers = Readers::start(modbus, daemon.http_address().ok_or("no HTTP")?, *DRIVES.end(), TENTH);
    let before = record(line, time, format);
    std::thread::sleep(time);
    runtime.block_on(daemon.stop());
    if readers.stop() == 0 {
        return Err("the north sides of the gateway did not answer".into());
    }
    Ok(before)
}

fn configuration(port: &str, baud: u32, profiles: &Path) -> String {
    let drives: String = DRIVES
        .map(|a| format!("[[bus.drive]]\nname = \"drive-{a}\"\naddress = {a}\nprofile = \"process-data\"\nturnaround = \"0.5ms\"\n"))
        .collect();
    format!(
        "[gateway]\nname = \"bench\"\nprofile_dirs = [\"{}\"]\n\
         [[bus]]\nname = \"line\"\nport = \"{port}\"\nbaud = {baud}\nformat = \"8N1\"\nsilence = \"chars\"\n{drives}\
         [modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\n[http]\nlisten = \"127.0.0.1:0\"\n",
        profiles.display()
    )
}
