//! Durations as people write them: `0.5ms`, `10 s`, `2min`.

use std::time::Duration;

/// A duration: a number, not negative, and one of `us`, `ms`, `s`, `min` or `m`, `h`; `None` if the text is not one.
pub fn parse(text: &str) -> Option<Duration> {
    let trimmed = text.trim();
    let digits = trimmed.find(|c: char| !c.is_ascii_digit() && c != '.')?;
    let (number, unit) = trimmed.split_at(digits);
    let number: f64 = number.parse().ok()?;
    let seconds = match unit.trim_start() {
        "us" | "µs" => 1e-6,
        "ms" => 1e-3,
        "s" => 1.0,
        "min" | "m" => 60.0,
        "h" => 3600.0,
        _ => return None,
    };
    Duration::try_from_secs_f64(number * seconds).ok()
}

/// The shortest text that [`parse`] reads as `time`.
pub fn format(time: Duration) -> String {
    match (time.as_secs(), time.subsec_nanos()) {
        (0, 0) => "0s".to_string(),
        (seconds, 0) if seconds % 3600 == 0 => format!("{}h", seconds / 3600),
        (seconds, 0) if seconds % 60 == 0 => format!("{}min", seconds / 60),
        (0, nanos) if nanos < 1000 => format!("{}us", f64::from(nanos) / 1e3),
        _ => format!("{time:?}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_read_and_written() {
        assert_eq!(parse("0.5ms"), Some(Duration::from_micros(500)));
        assert_eq!(parse("2min"), Some(Duration::from_secs(120)));
        assert_eq!(parse("10m"), parse("10min"));
        assert_eq!(parse("10 s"), Some(Duration::from_secs(10)));
        for bad in ["", "10", "ms", "-1s", "1d", "1.2.3s", "1e3s"] {
            assert_eq!(parse(bad), None, "{bad}");
        }
        for text in ["0s", "0.5us", "303.819µs", "10ms", "1.5s", "90s", "2min", "1h"] {
            assert_eq!(format(parse(text).unwrap()), text);
        }
    }
}
