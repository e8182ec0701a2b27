//! `drivegate trace`: the frames on the lines of a running gateway.

mod pcap;

use std::fs::File;
use std::io::{self, IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, SystemTime};

use serde::Deserialize;
use tokio::signal::unix::{SignalKind, signal};

use self::pcap::Capture;
use super::client::{EventStream, Gateway, encoded};
use super::failure::Outcome;
use super::printable;
use drivegate_core::process_image::Direction;

/// Interval at which the capture is flushed.
const FLUSH: Duration = Duration::from_secs(1);

/// Shows the frames on the lines of a running gateway, with times, gaps and meaning.
///
/// Adds no traffic to the line. Times are UTC: for a request when it was passed to the port, for a reply when its last
/// byte arrived. The gap is the silence before the frame, in microseconds.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  drivegate trace --bus line1\n  \
    drivegate trace --bus line1 --count 1000 --pcap line1.pcap\n\n\
    The capture has the link type RTAC Serial (250). Wireshark shows Modbus after Analyze, Decode As,\n\
    field \"RTAC Serial Data Subdissector\", current \"Modbus RTU\"; tshark by -d rtacser.data,mbrtu\n\n\
    Exit codes: 0 after Ctrl-C, --count or a closed pipe, 1 when the gateway sends no frames (any more).")]
pub(super) struct Args {
    #[command(flatten)]
    gateway: Gateway,
    /// Only this bus [default: all].
    #[arg(long, value_name = "NAME")]
    bus: Option<String>,
    /// Write the frames to this file too, for Wireshark; an existing one is overwritten.
    #[arg(long, value_name = "FILE")]
    pcap: Option<PathBuf>,
    /// Stop after this many frames.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async {
        trace(args).await?;
        Ok(ExitCode::SUCCESS)
    })
}

/// Shows frames until Ctrl-C, until `--count` is reached, or until the output is closed.
async fn trace(args: &Args) -> Result<(), String> {
    let signals = |error: io::Error| format!("cannot handle signals: {error}; the system; free file descriptors");
    let mut interrupt = signal(SignalKind::interrupt()).map_err(signals)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(signals)?;
    let path = match &args.bus {
        None => "/api/v1/trace".to_string(),
        Some(bus) => format!("/api/v1/trace?bus={}", encoded(bus)),
    };
    let client = args.gateway.viewer()?;
    let mut stream = tokio::select! {
        stream = EventStream::open(&client, &path) => stream.map_err(|error| error.to_string())?,
        _ = interrupt.recv() => return Ok(()),
        _ = terminate.recv() => return Ok(()),
    };
    let mut view = View::open(args)?;
    let mut tick = tokio::time::interval(FLUSH);
    let ended = loop {
        let next = tokio::select! {
            event = stream.next() => event,
            _ = tick.tick() => {
                view.flush()?;
                continue;
            }
            _ = interrupt.recv() => break Ok(()),
            _ = terminate.recv() => break Ok(()),
        };
        let shown = match next {
            Ok(event) if event.name == "lagged" => view.lagged(&event.data),
            Ok(event) if event.name.is_empty() => view.frame(&event.data),
            // Events of later versions are ignored.
            Ok(_) => Ok(More::Yes),
            Err(error) => break Err(error.to_string()),
        };
        match shown {
            Ok(More::Yes) => {}
            Ok(More::No) => break Ok(()),
            Err(message) => break Err(message),
        }
    };
    let closed = view.close();
    ended.and(closed)
}

/// Whether to continue.
#[derive(Debug, PartialEq, Eq)]
enum More {
    Yes,
    No,
}

/// A frame in the form in which the gateway sends it.
#[derive(Debug, Deserialize)]
struct Frame {
    bus: String,
    time: String,
    gap_us: Option<u64>,
    direction: Direction,
    #[serde(default)]
    drive: Option<String>,
    hex: String,
    /// The bytes as text, where the protocol is text.
    #[serde(default)]
    text: Option<String>,
    #[serde(default)]
    decode: String,
    #[serde(default)]
    verdict: String,
}

/// Number of frames that a slow listener has lost.
#[derive(Debug, Deserialize)]
struct Lagged {
    lost: u64,
}

/// Where and how the frames are shown.
struct View {
    colours: bool,
    with_bus: bool,
    left: Option<u64>,
    capture: Option<(PathBuf, Capture<File>)>,
    /// The line of the capture.
    captured_bus: Option<String>,
}

impl View {
    fn open(args: &Args) -> Result<View, String> {
        let capture = match &args.pcap {
            None => None,
            Some(path) => {
                let capture = Capture::create(path).map_err(|error| unwritable(path, &error))?;
                Some((path.clone(), capture))
            }
        };
        let mut view = View {
            colours: io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty()),
            with_bus: args.bus.is_none(),
            left: args.count,
            capture,
            captured_bus: None,
        };
        let head = format!(
            "{:<15} {:>8} {}  {:<12} {:<24} decode, verdict",
            "time (UTC)",
            "gap µs",
            if view.with_bus { "bus       " } else { "" },
            "drive",
            "bytes"
        );
        view.print(&head)?;
        Ok(view)
    }

    fn frame(&mut self, data: &str) -> Result<More, String> {
        let frame: Frame = serde_json::from_str(data).map_err(|error| {
            format!("cannot parse a frame of the gateway ({error}); {data}; use the same version on both sides")
        })?;
        self.keep(&frame)?;
        if self.print(&line(&frame, self.with_bus, self.colours))? == More::No {
            return Ok(More::No);
        }
        if let Some(left) = &mut self.left {
            *left = left.saturating_sub(1);
            if *left == 0 {
                return Ok(More::No);
            }
        }
        Ok(More::Yes)
    }

    fn lagged(&mut self, data: &str) -> Result<More, String> {
        let lost = serde_json::from_str::<Lagged>(data).map_or(0, |lagged| lagged.lost);
        if let Some((path, capture)) = &mut self.capture {
            capture
                .lost(SystemTime::now())
                .map_err(|error| unwritable(path, &error))?;
        }
        let text = format!("--- {lost} frames dropped: they arrived faster than they were read");
        self.print(&paint(&text, YELLOW, self.colours))
    }

    /// Adds a frame to the capture.
    fn keep(&mut self, frame: &Frame) -> Result<(), String> {
        let Some((path, capture)) = &mut self.capture else {
            return Ok(());
        };
        let bus = self.captured_bus.get_or_insert_with(|| frame.bus.clone());
        if *bus != frame.bus {
            return Err(format!(
                "a capture holds one bus, but frames of {bus} and {} arrived; {}; choose one with --bus",
                frame.bus,
                path.display()
            ));
        }
        let strange = || {
            format!(
                "cannot parse a frame; {}; use the same version on both sides",
                frame.time
            )
        };
        let time = humantime::parse_rfc3339_weak(&frame.time).map_err(|_| strange())?;
        let bytes = bytes(&frame.hex).ok_or_else(strange)?;
        // A timeout has no bytes.
        if bytes.is_empty() {
            return Ok(());
        }
        capture
            .frame(time, frame.direction, &bytes)
            .map_err(|error| unwritable(path, &error))
    }

    /// Prints a line; a closed output ends the command.
    fn print(&mut self, line: &str) -> Result<More, String> {
        let mut stdout = io::stdout().lock();
        match writeln!(stdout, "{line}").and_then(|()| stdout.flush()) {
            Ok(()) => Ok(More::Yes),
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(More::No),
            Err(error) => Err(format!(
                "cannot write the output: {error}; stdout; free space, or redirect it"
            )),
        }
    }

    fn flush(&mut self) -> Result<(), String> {
        match &mut self.capture {
            Some((path, capture)) => capture.flush().map_err(|error| unwritable(path, &error)),
            None => Ok(()),
        }
    }

    /// Closes the capture and reports its size.
    fn close(mut self) -> Result<(), String> {
        self.flush()?;
        if let Some((path, capture)) = &self.capture {
            let text = format!("{} frames written to {}", capture.packets(), path.display());
            // If this cannot be printed, nothing is lost.
            let _ = writeln!(io::stderr().lock(), "{text}");
        }
        Ok(())
    }
}

fn unwritable(path: &std::path::Path, error: &io::Error) -> String {
    format!(
        "cannot write the capture: {error}; {}; name a file that can be written",
        path.display()
    )
}

const RED: &str = "31";
const GREEN: &str = "32";
const YELLOW: &str = "33";
const CYAN: &str = "36";
const DIM: &str = "2";

fn paint(text: &str, colour: &str, colours: bool) -> String {
    if colours && !text.is_empty() {
        format!("\x1b[{colour}m{text}\x1b[0m")
    } else {
        text.to_string()
    }
}

/// `07:40:12.118304     1792 > pump-1       01 03 08 34 00 0B 47 A3  read holding 2100..2110`.
fn line(frame: &Frame, with_bus: bool, colours: bool) -> String {
    let time = frame.time.split_once('T').map_or(frame.time.as_str(), |(_, time)| time);
    let gap = frame.gap_us.map_or("-".to_string(), |gap| gap.to_string());
    let (arrow, colour) = match frame.direction {
        Direction::Request => ('>', CYAN),
        Direction::Reply => ('<', GREEN),
    };
    let verdict_colour = match frame.verdict.as_str() {
        "ok" => DIM,
        verdict if verdict == "timeout" || verdict.starts_with("corrupt") => RED,
        _ => YELLOW,
    };
    let bus = if with_bus {
        format!("{:<10} ", printable::line(&frame.bus))
    } else {
        String::new()
    };
    let drive = printable::line(frame.drive.as_deref().unwrap_or("-"));
    let mut meaning = vec![];
    // For an exception, decoded text and verdict are equal, so only one of them is printed.
    if frame.decode != frame.verdict {
        meaning.push(printable::line(&frame.decode));
    }
    meaning.push(paint(&printable::line(&frame.verdict), verdict_colour, colours));
    meaning.retain(|text| !text.is_empty());
    let text = [
        format!("{} {gap:>8}", printable::line(time.trim_end_matches('Z'))),
        format!("{bus}{}", paint(&format!("{arrow} {drive:<12}"), colour, colours)),
        format!("{:<23} ", printable::line(frame.text.as_ref().unwrap_or(&frame.hex))),
        meaning.join("  "),
    ];
    text.join(" ").trim_end().to_string()
}

/// The bytes of `01 03 AB`.
fn bytes(hex: &str) -> Option<Vec<u8>> {
    hex.split_whitespace()
        .map(|byte| u8::from_str_radix(byte, 16).ok())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(direction: &str, gap: &str, hex: &str, decode: &str, verdict: &str) -> Frame {
        serde_json::from_str(&format!(
            "{{\"bus\":\"line1\",\"time\":\"2026-03-02T07:40:12.118304Z\",\"gap_us\":{gap},\"direction\":\"{direction}\",\
             \"drive\":\"pump-1\",\"hex\":\"{hex}\",\"decode\":\"{decode}\",\"verdict\":\"{verdict}\"}}"
        ))
        .unwrap()
    }

    #[test]
    fn lines() {
        let request = frame(
            "request",
            "1792",
            "01 03 08 34 00 0B 47 A3",
            "read holding 2100..2110",
            "",
        );
        assert_eq!(
            line(&request, false, false),
            "07:40:12.118304     1792 > pump-1       01 03 08 34 00 0B 47 A3  read holding 2100..2110"
        );
        let timeout = frame("reply", "null", "", "", "timeout");
        assert_eq!(
            line(&timeout, true, false),
            "07:40:12.118304        - line1      < pump-1                                timeout"
        );
        let exception = "exception 02 (illegal data address)";
        let refused = line(
            &frame("reply", "9", "01 83 02 C0 F1", exception, exception),
            false,
            true,
        );
        assert_eq!(refused.matches(exception).count(), 1);
        assert!(refused.contains("\x1b[33mexception"), "{refused:?}");
    }

    #[test]
    fn text_is_shown_as_text() {
        let mut request = frame("request", "1792", "3A 30 0D 0A", "read holding 32..33", "");
        request.text = Some(":010300200002DA\u{240D}\u{240A}".to_string());
        assert_eq!(
            line(&request, false, false),
            "07:40:12.118304     1792 > pump-1       :010300200002DA\u{240D}\u{240A}        read holding 32..33"
        );
    }

    #[test]
    fn a_name_commands_no_terminal() {
        let bad = frame("reply", "1", "01", "\\u001b[2Jx", "ok");
        assert!(line(&bad, false, false).contains("\\u001b[2Jx"));
    }

    #[test]
    fn bytes_of_hex() {
        assert_eq!(bytes("01 03 AB"), Some(vec![1, 3, 0xAB]));
        assert_eq!(bytes(""), Some(Vec::new()));
        assert_eq!(bytes("0g"), None);
    }
}
