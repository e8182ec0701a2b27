//! `drivegate watch`: the drives and lines of a running gateway, live.

use std::io::{self, IsTerminal, Write};
use std::process::ExitCode;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::signal::unix::{SignalKind, signal};

use super::client::{Client, Gateway};
use super::failure::Outcome;
use super::{printable, report};

/// Interval at which the display is refreshed.
const PAUSE: Duration = Duration::from_millis(500);

/// Shows the drives and lines of a running gateway, live.
///
/// On a terminal the table refreshes twice a second until Ctrl-C; otherwise it is printed once.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  drivegate watch\n  drivegate watch --url http://10.0.0.5:9488 --once\n  \
    drivegate watch --url https://gateway.example:9488 --ca ca.crt --token-file token"
)]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Print the table once and exit.
    #[arg(long)]
    once: bool,
    /// JSON instead of tables: a line each time.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(watch(args))
}

async fn watch(args: &Args) -> Outcome {
    let client = args.gateway.viewer()?;
    let live = !args.once && (args.json || io::stdout().is_terminal());
    if !live && args.json {
        let document = document(&client).await;
        let failed = document.as_ref().err().map(|why| why.clone().into());
        report::print_bytes(&json_line(document));
        return failed.map_or(Ok(ExitCode::SUCCESS), Err);
    }
    if !live {
        return Ok(report::print(&page(&client).await?));
    }
    let signals = |error: io::Error| format!("cannot handle signals: {error}; the system; free file descriptors");
    let mut interrupt = signal(SignalKind::interrupt()).map_err(signals)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(signals)?;
    let mut tick = tokio::time::interval(PAUSE);
    loop {
        tokio::select! {
            _ = interrupt.recv() => return Ok(ExitCode::SUCCESS),
            _ = terminate.recv() => return Ok(ExitCode::SUCCESS),
            _ = tick.tick() => {}
        }
        if args.json {
            let line = json_line(document(&client).await);
            let mut stdout = io::stdout().lock();
            if stdout.write_all(&line).and_then(|()| stdout.flush()).is_err() {
                return Ok(ExitCode::SUCCESS);
            }
            continue;
        }
        // The display continues through a restart of the gateway.
        let text = match page(&client).await {
            Ok(text) => text,
            Err(why) => format!("{why}\n\nretrying\n"),
        };
        let mut stdout = io::stdout().lock();
        // Redraws from the top, clearing the rest of each line and of the screen.
        let text = printable::lines(&text).replace('\n', "\x1b[K\r\n");
        if write!(stdout, "\x1b[H{text}\x1b[J")
            .and_then(|()| stdout.flush())
            .is_err()
        {
            return Ok(ExitCode::SUCCESS);
        }
    }
}

/// Buses and drives as the gateway reports them.
async fn document(client: &Client) -> Result<Value, String> {
    let buses: Value = client.view("/api/v1/buses").await?;
    let drives: Value = client.view("/api/v1/drives").await?;
    Ok(json!({ "buses": buses, "drives": drives }))
}

/// A line of JSON, also if there is no answer.
fn json_line(document: Result<Value, String>) -> Vec<u8> {
    let document = document.unwrap_or_else(|why| json!({ "error": why }));
    format!("{document}\n").into_bytes()
}

async fn page(client: &Client) -> Result<String, String> {
    let buses = client.view("/api/v1/buses").await?;
    let drives = client.view("/api/v1/drives").await?;
    Ok(format!("{}\n{}", lines(&buses), table(&drives)))
}

fn lines(buses: &Value) -> String {
    let mut table = report::table([
        "bus",
        "state",
        "line",
        "load",
        "fast ms",
        "slow ms",
        "drives",
        "exchanges",
        "errors",
        "queue",
    ]);
    for bus in buses.as_array().into_iter().flatten() {
        let load = value_at(bus, "/load_ratio").as_f64();
        table.add_row([
            text(value_at(bus, "/name")),
            text(value_at(bus, "/state")),
            format!(
                "{} {} {}",
                text(value_at(bus, "/protocol")),
                text(value_at(bus, "/baud")),
                text(value_at(bus, "/format"))
            ),
            load.map_or_else(String::new, |load| format!("{:.1} %", load * 100.0)),
            fixed(value_at(bus, "/fast/cycle_ms"), 1),
            fixed(value_at(bus, "/slow/cycle_ms"), 0),
            format!(
                "{} of {}",
                text(value_at(bus, "/online")),
                text(value_at(bus, "/drives"))
            ),
            text(value_at(bus, "/transactions")),
            text(value_at(bus, "/errors")),
            text(value_at(bus, "/queue_depth")),
        ]);
    }
    report::lines(&table)
}

fn table(drives: &Value) -> String {
    let mut heads = vec![
        "drive",
        "unit",
        "profile",
        "state",
        "age ms",
        "Hz",
        "rpm",
        "A",
        "reference %",
        "turnaround ms",
        "fault",
    ];
    // The column exists only where `[authority]` is on.
    let held = drives
        .as_array()
        .into_iter()
        .flatten()
        .any(|drive| value_at(drive, "/hold").is_string());
    if held {
        heads.push("held by");
    }
    let mut table = report::table(heads);
    for drive in drives.as_array().into_iter().flatten() {
        let good = |name: &str, digits: usize| {
            let point = value_at(drive, &format!("/points/{name}"));
            // Values that are not good, or that a newer state contradicts, are left out.
            if value_at(point, "/quality") == "good" && value_at(point, "/contradicted") != true {
                fixed(value_at(point, "/value"), digits)
            } else {
                String::new()
            }
        };
        let mut row = vec![
            text(value_at(drive, "/name")),
            text(value_at(drive, "/unit")),
            text(value_at(drive, "/profile")),
            state(drive),
            text(value_at(drive, "/age_ms")),
            good("output_frequency", 2),
            good("motor_speed", 0),
            good("motor_current", 1),
            good("speed_reference", 2),
            fixed(value_at(drive, "/turnaround_ms"), 2),
            text(value_at(drive, "/fault_text")),
        ];
        if held {
            row.push(holder(drive));
        }
        table.add_row(row);
    }
    report::lines(&table)
}

/// The holder of the drive, and the seconds left.
fn holder(drive: &Value) -> String {
    let who = || {
        format!(
            "{} ({})",
            text(value_at(drive, "/holder")),
            text(value_at(drive, "/holder_rank"))
        )
    };
    let left = || value_at(drive, "/hold_left_s").as_u64().unwrap_or_default();
    match value_at(drive, "/hold").as_str() {
        Some("held") => format!("{}, {} s", who(), left()),
        Some("reserved") => format!("reserved for {}, {} s", who(), left()),
        Some("local") => "local control place".to_string(),
        _ => String::new(),
    }
}

/// The state, with the warning that the drive reports.
fn state(drive: &Value) -> String {
    let state = value_at(drive, "/state").as_str().unwrap_or("unknown");
    let warning = value_at(drive, "/points/warning");
    let is_warned = value_at(warning, "/quality") == "good" && value_at(warning, "/value") == true;
    let warned = if is_warned { ", warning" } else { "" };
    format!("{state}{warned}")
}

/// The value at `pointer`, or null.
fn value_at<'v>(value: &'v Value, pointer: &str) -> &'v Value {
    value.pointer(pointer).unwrap_or(&Value::Null)
}

fn text(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

fn fixed(value: &Value, digits: usize) -> String {
    value
        .as_f64()
        .map_or_else(String::new, |number| format!("{number:.digits$}"))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_holder_is_shown_where_drives_are_held() {
        let drive = |hold: Value, holder: Value, rank: Value, left: Value| json!([{"name": "p", "hold": hold, "holder": holder, "holder_rank": rank, "hold_left_s": left}]);
        let shown = table(&drive(json!("held"), json!("plc-1"), json!("automation"), json!(24)));
        assert!(
            shown.contains("held by") && shown.contains("plc-1 (automation), 24 s"),
            "{shown}"
        );
        let shown = table(&drive(json!("reserved"), json!("alice"), json!("operator"), json!(9)));
        assert!(shown.contains("reserved for alice (operator), 9 s"), "{shown}");
        let shown = table(&drive(json!("local"), json!("local"), json!("local"), Value::Null));
        assert!(shown.contains("local control place"), "{shown}");
        assert!(table(&drive(json!("free"), Value::Null, Value::Null, json!(0))).contains("held by"));
        assert!(!table(&json!([{"name": "p"}])).contains("held by"));
    }

    #[test]
    fn what_is_not_good_is_no_figure() {
        let point = |value: f64, quality: &str| json!({"value": value, "quality": quality});
        let drives = json!([{
            "name": "pump-1", "unit": 1, "profile": "vacon-nx", "state": "running", "age_ms": 12, "fault_text": "",
            "turnaround_ms": 0.5,
            "points": {"output_frequency": point(25.0, "good"), "motor_current": point(4.2, "stale")},
        }]);
        let text = table(&drives);
        let row = text.lines().last().unwrap();
        assert!(
            row.contains("pump-1") && row.contains("25.00") && !row.contains("4.2"),
            "{text}"
        );
        let mut warned =
            json!([{"name": "fan-1", "state": "ready", "points": {"warning": {"value": true, "quality": "good"}}}]);
        assert!(table(&warned).contains("ready, warning"));
        warned[0]["points"]["warning"]["quality"] = "stale".into();
        assert!(!table(&warned).contains("warning"), "not a fresh one");
        let unknown = json!([{"name": "fan-1", "state": null}]);
        assert!(table(&unknown).contains("unknown"), "a state that is not known");
    }

    #[test]
    fn a_line_that_never_had_a_round() {
        let buses = json!([{"name": "line1", "state": "down", "protocol": "n2", "baud": 9600, "format": "8N1", "online": 0, "drives": 2,
            "load_ratio": 0.0, "fast": {"cycle_ms": null}, "slow": {"cycle_ms": null}, "transactions": 0, "errors": 0, "queue_depth": 0}]);
        let text = lines(&buses);
        assert!(text.contains("n2 9600 8N1") && text.contains("0 of 2"), "{text}");
        assert!(text.contains("0.0 %"), "a bus that is down has no load");
        let opened = json!([{"name": "line1", "state": "up", "load_ratio": null}]);
        assert!(!lines(&opened).contains('%'), "not known in the first second");
    }
}
