//! Evidence from a real trunk for or against the assumptions about N2 ([`ASSUMPTIONS`](drivegate_proto::n2::ASSUMPTIONS)).
//! Pure.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::{Duration, Instant};

use super::decoder::{Exchange, Traffic};
use drivegate_proto::n2::command::checksum;
use drivegate_proto::n2::{Answer, Command, Object, Region};

/// Different values of one kind that are counted apart.
const MOST_VALUES: usize = 16;

/// How often each of some values was seen.
type Seen = BTreeMap<String, u64>;

/// Observations on an N2 line.
#[derive(Debug, Default)]
pub struct N2Survey {
    /// Number of lines of master and drives whose checksum is, or is not, the sum of their characters.
    sums: [u64; 2],
    /// Number of overrides and releases by the number of digits of the region.
    widths: Seen,
    /// Status bytes of binary objects that were seen.
    states: Seen,
    /// Device types that were seen.
    devices: Seen,
    /// How often a drive asked to be identified.
    unidentified: u64,
    /// Number of overrides of analog outputs, and of their releases.
    overrides: u64,
    releases: u64,
    /// Number of polls, by form and by kind of answer.
    polls: Seen,
    reports: Seen,
    last_polls: BTreeMap<u8, Instant>,
    intervals: (u64, Duration),
    /// Digits of the answers to reads of floats and integers.
    floats: Seen,
    integers: Seen,
    /// Number of refusals, by their form.
    refusals: Seen,
    /// Received floats that are not numbers.
    no_numbers: Seen,
    /// Objects of number 0, and the others.
    numbers: [u64; 2],
    times: u64,
    /// Number of commands of other kinds.
    others: u64,
}

fn count(seen: &mut Seen, what: impl Into<String>) {
    let what = what.into();
    if seen.len() < MOST_VALUES || seen.contains_key(&what) {
        *seen.entry(what).or_default() += 1;
    }
}

impl N2Survey {
    /// Adds a received frame to the survey.
    pub fn add(&mut self, heard: &Traffic) {
        match heard {
            Traffic::Exchange(exchange) => self.exchange(exchange),
            Traffic::Stray { bytes, .. } => self.sum(bytes),
        }
    }

    /// Whether the checksum of a request, or of an answer with data, is formed as assumed.
    fn sum(&mut self, line: &[u8]) {
        // An A may be a digit as well.
        let request = line.iter().rposition(|byte| *byte == b'>');
        let begin = request.or_else(|| line.iter().position(|byte| *byte == b'A'));
        let text = begin.and_then(|begin| line.get(begin + 1..)?.strip_suffix(b"\r"));
        let Some((body, check)) = text.and_then(|text| text.split_at_checked(text.len().checked_sub(2)?)) else {
            return;
        };
        if body.is_empty() || !body.iter().all(u8::is_ascii_hexdigit) {
            return;
        }
        let fits = check.eq_ignore_ascii_case(format!("{:02X}", checksum(body)).as_bytes());
        if let Some(sums) = self.sums.get_mut(usize::from(!fits)) {
            *sums += 1;
        }
    }

    fn exchange(&mut self, exchange: &Exchange) {
        self.sum(&exchange.frame);
        let answer = exchange.heard.iter().position(u8::is_ascii_graphic);
        let answer = answer.and_then(|begin| exchange.heard.get(begin..)).unwrap_or_default();
        self.sum(answer);
        let line = answer.strip_suffix(b"\r").unwrap_or_default();
        let decoded = Answer::decode(line).ok();
        if let Some(Answer::Nak(code)) = &decoded {
            self.unidentified += u64::from(*code == 0);
            count(
                &mut self.refusals,
                if line.len() == 3 {
                    "without a checksum"
                } else {
                    "with a checksum"
                },
            );
        }
        let Some((address, Ok(command))) = Command::decode(&exchange.frame) else {
            return;
        };
        match command {
            Command::Identify => {
                if let Some(Answer::Data(digits)) = decoded {
                    count(&mut self.devices, text(&digits));
                }
            }
            Command::Poll { again } => self.poll(address, again, decoded.as_ref(), exchange.began),
            Command::Read { object, attribute } => {
                self.number(object);
                if attribute == object.region.value_attribute() {
                    self.read(object, decoded.as_ref());
                }
            }
            Command::Override { object, .. } => {
                self.number(object);
                self.width(&exchange.frame);
                self.overrides += u64::from(object.region == Region::Ao);
            }
            Command::Release { object } => {
                self.number(object);
                self.width(&exchange.frame);
                self.releases += u64::from(object.region == Region::Ao);
            }
            Command::SyncTime => self.times += 1,
            _ => self.others += 1,
        }
    }

    fn number(&mut self, object: Object) {
        if let Some(numbers) = self.numbers.get_mut(usize::from(object.number != 0)) {
            *numbers += 1;
        }
    }

    /// Counts the width of the region number that follows `>aa72` or `>aa73`. A leading 0 indicates two digits.
    fn width(&mut self, frame: &[u8]) {
        let begin = frame.iter().rposition(|byte| *byte == b'>').unwrap_or(0);
        let two = frame.get(begin + 5) == Some(&b'0');
        count(&mut self.widths, if two { "2 digits" } else { "1 digit" });
    }

    fn poll(&mut self, address: u8, again: bool, answer: Option<&Answer>, at: Instant) {
        count(&mut self.polls, if again { "0/5" } else { "0/4" });
        if let Some(before) = self.last_polls.insert(address, at) {
            self.intervals.0 += 1;
            self.intervals.1 += at.saturating_duration_since(before);
        }
        match answer {
            Some(Answer::Ack) => count(&mut self.reports, "A alone"),
            Some(Answer::Data(digits)) => count(&mut self.reports, format!("{} digits", digits.len())),
            _ => {}
        }
    }

    fn read(&mut self, object: Object, answer: Option<&Answer>) {
        let Some(Answer::Data(digits)) = answer else { return };
        match object.region {
            Region::Bi | Region::Bo => count(&mut self.states, text(digits)),
            Region::Adi => count(&mut self.integers, format!("{} digits", digits.len())),
            Region::Bd => {}
            Region::Ai | Region::Ao | Region::Adf => {
                count(&mut self.floats, format!("{} digits", digits.len()));
                let value = digits
                    .len()
                    .checked_sub(8)
                    .and_then(|from| digits.get(from..))
                    .map(text);
                let bits = value.as_ref().and_then(|value| u32::from_str_radix(value, 16).ok());
                if let Some(value) = value.filter(|_| bits.is_some_and(|bits| !f32::from_bits(bits).is_finite())) {
                    count(&mut self.no_numbers, value);
                }
            }
        }
    }

    /// A line for each assumption, with the observations about it.
    pub fn report(&self) -> String {
        let mut out = String::new();
        let mut line = |what: &str, seen: String| {
            // Writing to a string cannot fail.
            let _ = writeln!(out, "  {what}\n    {seen}");
        };
        let [right, wrong] = self.sums;
        let of_sums = match (right, wrong) {
            (0, 0) => "not seen".to_string(),
            (_, 0) => format!("confirmed by {right} lines"),
            (0, _) => format!("contradicted by all {wrong} lines"),
            _ => format!("confirmed by {right} lines; {wrong} others, which may have been damaged on the line"),
        };
        line(
            "checksum: sum of the characters behind the lead character, modulo 256",
            of_sums,
        );
        line("region in override and release: 2 digits", list(&self.widths));
        line(
            "status byte of BI and BO: bit 6 holds the state, others may mark it as unreliable",
            format!(
                "values seen: {}; compare with the states that the drives show",
                list(&self.states)
            ),
        );
        line(
            "a drive replies to nothing before Identify (N00)",
            format!("{} times N00 was answered", self.unidentified),
        );
        line("device type 10", list(&self.devices));
        line(
            "an overridden AO is released at once",
            format!("{} overrides, {} releases", self.overrides, self.releases),
        );
        let interval = u32::try_from(self.intervals.0).ok().filter(|n| *n > 0);
        let interval = interval.map(|n| self.intervals.1 / n);
        line(
            "polls for changes: 0/4 first, then 0/5",
            match interval {
                Some(interval) => format!("{}; every {:.1} s a drive", list(&self.polls), interval.as_secs_f64()),
                None => list(&self.polls),
            },
        );
        line("no changes: A alone; a report has data", list(&self.reports));
        line("a float has 8 digits, or 10 with a byte before it", list(&self.floats));
        line(
            "an integer has 4 digits, or 6 with a byte before it",
            list(&self.integers),
        );
        line("a refusal has no checksum", list(&self.refusals));
        line("any NaN or infinity means no value", list(&self.no_numbers));
        let [zero, others] = self.numbers;
        line(
            "object numbers are those of the printed maps, from 1",
            format!("{others} of 1 and more, {zero} of 0"),
        );
        line(
            "time is not synchronised",
            format!("{} commands with a time", self.times),
        );
        line("other commands are not used", format!("{} seen", self.others));
        out
    }
}

fn text(digits: &[u8]) -> String {
    String::from_utf8_lossy(digits).to_ascii_uppercase()
}

fn list(seen: &Seen) -> String {
    if seen.is_empty() {
        return "not seen".to_string();
    }
    let one = |(what, count): (&String, &u64)| format!("{what} ({count}×)");
    seen.iter().map(one).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A request and its reply, both given without the carriage return.
    fn exchange(began: Instant, request: &str, reply: &str) -> Traffic {
        Traffic::Exchange(Box::new(Exchange {
            address: 1,
            request: None,
            frame: format!("{request}\r").into_bytes(),
            quiet_since: began,
            began,
            sent: began,
            heard: format!("{reply}\r").into_bytes(),
            replied: Some(began),
            at: began,
            asked_by: began,
            ended: None,
            doubt: None,
        }))
    }

    fn report(exchanges: &[(&str, &str)]) -> String {
        let start = Instant::now();
        let mut survey = N2Survey::default();
        for (second, (request, reply)) in exchanges.iter().enumerate() {
            survey.add(&exchange(start + Duration::from_secs(second as u64), request, reply));
        }
        survey.report()
    }

    /// The part of the report about an assumption.
    fn said<'r>(report: &'r str, assumption: &str) -> &'r str {
        let mut lines = report.lines().skip_while(|line| !line.contains(assumption));
        lines.nth(1).map_or("no such line", str::trim)
    }

    // Frames: the worked examples of N2 (identify, poll, read BI2, ADF5 and ADI1, override and release of AO1).

    #[test]
    fn what_fits_is_confirmed() {
        let report = report(&[
            (">01FA7", "N00"),
            (">01FA7", "A1061"),
            (">0104C5", "A"),
            (">0105C6", "A"),
            (">0112020288", "A4064"),
            (">011505028E", "A3FC00000AC"),
            (">011601028B", "A0035C8"),
            (">017203014248000020", "A"),
            (">017303018F", "A"),
        ]);
        // Nine requests and four replies with data.
        assert_eq!(said(&report, "checksum"), "confirmed by 13 lines");
        assert_eq!(said(&report, "region in override"), "2 digits (2×)");
        assert!(
            said(&report, "status byte").starts_with("values seen: 40 (1×)"),
            "{report}"
        );
        assert_eq!(said(&report, "before Identify"), "1 times N00 was answered");
        assert_eq!(said(&report, "device type"), "10 (1×)");
        assert_eq!(said(&report, "released at once"), "1 overrides, 1 releases");
        assert_eq!(
            said(&report, "polls for changes"),
            "0/4 (1×), 0/5 (1×); every 1.0 s a drive"
        );
        assert_eq!(said(&report, "no changes"), "A alone (2×)");
        assert_eq!(said(&report, "a float has"), "8 digits (1×)");
        assert_eq!(said(&report, "an integer has"), "4 digits (1×)");
        assert_eq!(said(&report, "refusal"), "without a checksum (1×)");
        assert_eq!(said(&report, "object numbers"), "5 of 1 and more, 0 of 0");
    }

    #[test]
    fn what_differs_is_told() {
        let report = report(&[
            (">01FA8", "A1062"),
            (">017230142480000F0", "A"),
            (">011505028E", "A003FC000000C"),
            (">011601028B", "A00003528"),
            (">011505028E", "A7FC00000B0"),
        ]);
        assert!(
            said(&report, "checksum").starts_with("confirmed by 7 lines; 2 others"),
            "{report}"
        );
        assert_eq!(said(&report, "region in override"), "1 digit (1×)");
        assert_eq!(said(&report, "a float has"), "10 digits (1×), 8 digits (1×)");
        assert_eq!(said(&report, "an integer has"), "6 digits (1×)");
        assert_eq!(said(&report, "NaN"), "7FC00000 (1×)");
        assert_eq!(said(&N2Survey::default().report(), "checksum"), "not seen");
    }
}
