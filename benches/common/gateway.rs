//! The whole gateway in this process, on a simulated line of Vacon NX drives.

use std::error::Error;
use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::plant::Plant;
use drivegate_core::process_image::BusImage;
use drivegate_gateway::config::Settings;
use drivegate_gateway::daemon::Daemon;
use drivegate_proto::LineFormat;
use drivegate_sim::half_duplex::LineRules;
use drivegate_sim::simulated_drive::DriveOptions;
use drivegate_sim::wire::{SimulatedBus, SimulatedBusOptions};
use tokio::runtime::Runtime;

use super::Readers;

/// A simulated line of that many drives, 8N1.
pub fn line(baud: u32, drives: u8) -> Result<SimulatedBus, Box<dyn Error>> {
    let rules = LineRules::new(LineFormat::new(baud, "8N1")?);
    let drives = (1..=drives).map(DriveOptions::nx).collect();
    Ok(SimulatedBus::start(SimulatedBusOptions::new("bench", rules, drives))?)
}

/// A bus of the configuration; its drives are named after it with a number: `line-1`.
pub struct Bus<'a> {
    pub name: &'a str,
    pub port: &'a str,
    pub baud: u32,
    pub drives: u8,
    pub profile: &'a str,
    /// Further keys of the bus, and of each drive.
    pub keys: &'a str,
    pub drive_keys: &'a str,
}

impl<'a> Bus<'a> {
    /// Vacon NX drives that may be commanded, behind `port`.
    pub fn commanded(port: &'a str, baud: u32, drives: u8, keys: &'a str) -> Bus<'a> {
        Bus {
            name: "line",
            port,
            baud,
            drives,
            profile: "vacon-nx",
            keys,
            drive_keys: "access = \"control\"",
        }
    }

    pub fn toml(&self) -> String {
        let (name, keys, profile) = (self.name, self.drive_keys, self.profile);
        let drive =
            |a| format!("[[bus.drive]]\nname = \"{name}-{a}\"\naddress = {a}\nprofile = \"{profile}\"\n{keys}\n");
        let drives: String = (1..=self.drives).map(drive).collect();
        format!(
            "[[bus]]\nname = \"{name}\"\nport = \"{}\"\nbaud = {}\nformat = \"8N1\"\nsilence = \"chars\"\n{}\n{drives}",
            self.port, self.baud, self.keys
        )
    }
}

/// Modbus TCP and HTTP, the servers that are read, on free ports.
pub const NORTH: &str = "[modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\n[http]\nlisten = \"127.0.0.1:0\"\n";

/// Settings with a `[gateway]` section that has a name, and with the given rest.
pub fn settings(rest: &str) -> Result<Settings, Box<dyn Error>> {
    let source = format!("[gateway]\nname = \"bench\"\n{rest}");
    let loaded = Settings::parse("bench.toml", &source, std::iter::empty());
    Ok(loaded.settings.ok_or_else(|| format!("{:?}", loaded.errors))?)
}

/// The running gateway.
pub struct Gateway {
    pub runtime: Runtime,
    pub daemon: Daemon,
    pub plant: Arc<Plant>,
}

impl Gateway {
    /// Starts the gateway; returns when all drives of its first bus are online, or after 20 s.
    pub fn start(settings: Settings) -> Result<Gateway, Box<dyn Error>> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let daemon = runtime.block_on(Daemon::start(settings))?;
        let plant = daemon.plant().load_full();
        let gateway = Gateway { runtime, daemon, plant };
        let bus = gateway.bus()?;
        let deadline = Instant::now() + Duration::from_secs(20);
        while bus.online() < bus.drives.len() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(gateway)
    }

    /// First bus of the gateway.
    pub fn bus(&self) -> Result<Arc<BusImage>, Box<dyn Error>> {
        Ok(self.plant.buses.first().ok_or("no bus")?.image.clone())
    }

    /// Reads the north sides of the gateway ten times a second.
    pub fn read(&self) -> Result<Readers, Box<dyn Error>> {
        let modbus = self.daemon.modbus_tcp_addresses().first().copied();
        let http = self.daemon.http_address().ok_or("no HTTP")?;
        let units = self.bus()?.drives.len() as u8;
        Ok(Readers::start(modbus, http, units, Duration::from_millis(100)))
    }

    /// Stops the gateway.
    pub fn stop(self) {
        self.runtime.block_on(self.daemon.stop());
    }
}
