//! The wire's limit, what the bare master reaches of it on a simulated line, and how late the simulator itself is.
//!
//! `cargo bench --bench bare` (options: `--seconds 10`, `--baud 38400`, `--spin 80us`, `--master-spin 80us`).
//! Ten drives, reads of the eleven process data registers, 8N1, turnaround 0.5 ms, 3.5 characters of silence.

use drivegate::codec::{LineFormat, Request, RequestPdu, Table};
use drivegate::document::parse_duration;
use drivegate::sim::bare_master::{self, BareOptions};
use drivegate::sim::drive::DriveOptions;
use drivegate::sim::half_duplex::LineRules;
use drivegate::sim::wire::{SimulatedBus, SimulatedBusOptions};
use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

const DRIVES: std::ops::RangeInclusive<u8> = 1..=10;

fn main() -> ExitCode {
    match measure(&std::env::args().skip(1).collect::<Vec<_>>()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(arguments: &[String]) -> Result<(), Box<dyn Error>> {
    let option = |name: &str| arguments.iter().skip_while(|argument| *argument != name).nth(1);
    let seconds = option("--seconds").map_or(Ok(10), |text| text.parse())?;
    let bauds = option("--baud").map_or(Ok(vec![38_400, 115_200]), |text| text.parse().map(|baud| vec![baud]))?;
    let spin = option("--spin").map(|text| parse_duration(text)).transpose()?;
    let master_spin = option("--master-spin").map_or(Ok(Duration::from_micros(80)), |text| parse_duration(text))?;

    println!(
        "{:>8} {:>9} {:>9} {:>7} {:>9} {:>9} {:>10} {:>10} {:>10}",
        "baud", "limit/s", "reads/s", "share", "failures", "too early", "late p50", "late p99", "late max"
    );
    for baud in bauds {
        let format = LineFormat::new(baud, "8N1")?;
        let rules = LineRules::new(format);
        let turnaround = rules.turnaround;
        let mut options = SimulatedBusOptions::new("bench", rules, DRIVES.map(DriveOptions::nx).collect());
        options.spin = spin.unwrap_or(options.spin);
        let bus = SimulatedBus::start(options)?;
        let requests: Vec<Request> = DRIVES
            .map(|address| Request {
                address,
                pdu: RequestPdu::Read {
                    table: Table::Holding,
                    start: 2100,
                    count: 11,
                },
            })
            .collect();
        let master = BareOptions {
            format,
            silence: format.silence_chars(),
            timeout: Duration::from_millis(100),
            spin: master_spin,
        };
        let limit = requests
            .first()
            .map_or(0.0, |request| bare_master::wire_limit(&master, request, turnaround));
        let report = bare_master::run(
            Path::new(&bus.address()),
            &master,
            &requests,
            Duration::from_secs(seconds),
        )?;
        let micros = |quantile| bus.lateness(quantile).unwrap_or_default().as_nanos() as f64 / 1000.0;
        println!(
            "{:>8} {:>9.1} {:>9.1} {:>5.1} % {:>9} {:>9} {:>7.1} us {:>7.1} us {:>7.1} us",
            baud,
            limit,
            report.rate(),
            100.0 * report.rate() / limit,
            report.failures,
            bus.statistics().silence_violations,
            micros(0.5),
            micros(0.99),
            micros(1.0),
        );
    }
    Ok(())
}
