//! Masters by other authors that do equal work: tokio-modbus, and libmodbus if it is installed.

use std::error::Error;
use std::io;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use drivegate_line::{sharpen_timers, wait_until};
use tokio_modbus::client::{Reader, rtu};
use tokio_modbus::slave::{Slave, SlaveContext};
use tokio_serial::SerialStream;

use crate::common::compile;
use crate::{DRIVES, SPIN, TIMEOUT};

/// tokio-modbus for `time`, with a `pause` after each reply.
pub(crate) fn tokio_modbus(port: &str, baud: u32, pause: Duration, time: Duration) -> Result<(), Box<dyn Error>> {
    let port = port.to_string();
    let thread = std::thread::spawn(move || -> io::Result<()> {
        sharpen_timers();
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        runtime.block_on(async {
            let stream = SerialStream::open(&tokio_serial::new(&port, baud))?;
            let mut client = rtu::attach(stream);
            let start = Instant::now();
            for address in DRIVES.cycle() {
                if start.elapsed() >= time {
                    break;
                }
                client.set_slave(Slave(address));
                let patience = TIMEOUT + Duration::from_secs_f64(270.0 / f64::from(baud));
                // A failed read appears in the transcript of the line. The transcript is what this benchmark measures.
                let _ = tokio::time::timeout(patience, client.read_holding_registers(2100, 11)).await;
                // The timer of the runtime ticks once a millisecond, so the pause blocks the thread instead.
                wait_until(Instant::now() + pause, SPIN);
            }
            Ok(())
        })
    });
    thread.join().map_err(|_| "tokio-modbus panicked")??;
    Ok(())
}

/// The libmodbus master, built for this run.
pub(crate) struct Libmodbus {
    directory: tempfile::TempDir,
}

impl Libmodbus {
    /// Compiles the program with libmodbus.
    pub(crate) fn build() -> Result<Libmodbus, String> {
        let directory = tempfile::tempdir().map_err(|error| error.to_string())?;
        let libmodbus = Libmodbus { directory };
        compile("bus/libmodbus_master.c", &libmodbus.program())?;
        Ok(libmodbus)
    }

    fn program(&self) -> PathBuf {
        self.directory.path().join("master")
    }

    /// Runs the program for `time`, with a `pause` after each reply.
    pub(crate) fn run(&self, port: &str, baud: u32, pause: Duration, time: Duration) -> Result<(), Box<dyn Error>> {
        let numbers = [
            u64::from(baud),
            u64::from(*DRIVES.end()),
            time.as_micros() as u64,
            pause.as_nanos() as u64,
            SPIN.as_nanos() as u64,
            TIMEOUT.as_micros() as u64,
        ];
        let output = Command::new(self.program())
            .arg(port)
            .args(numbers.map(|number| number.to_string()))
            .output()?;
        if output.status.success() {
            Ok(())
        } else {
            Err(format!("libmodbus: {}", String::from_utf8_lossy(&output.stderr)).into())
        }
    }
}
