//! Statistics of the process, from /proc. What cannot be read is omitted.

use std::fs;

/// Statistics of the process.
#[derive(Debug, Default, PartialEq)]
pub(super) struct ProcessStats {
    pub(super) cpu_seconds: Option<f64>,
    pub(super) open_fds: Option<f64>,
    pub(super) max_fds: Option<f64>,
    pub(super) virtual_bytes: Option<f64>,
    pub(super) resident_bytes: Option<f64>,
    /// Start of the process as Unix time.
    pub(super) start_seconds: Option<f64>,
    pub(super) threads: Option<f64>,
}

/// The present statistics of the process.
pub(super) fn read() -> ProcessStats {
    let ticks = rustix::param::clock_ticks_per_second() as f64;
    let page = rustix::param::page_size() as f64;
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let boot = fs::read_to_string("/proc/stat").ok().and_then(|text| boot_time(&text));
    let mut figures = of_stat(&stat, ticks, page, boot);
    // Listing the directory opens a descriptor itself.
    figures.open_fds = fs::read_dir("/proc/self/fd")
        .ok()
        .map(|entries| entries.count().saturating_sub(1) as f64);
    figures.max_fds = rustix::process::getrlimit(rustix::process::Resource::Nofile)
        .current
        .map(|limit| limit as f64);
    figures
}

/// Statistics from a line of /proc/PID/stat. The second field is the program's name in parentheses and can contain
/// anything, so fields are counted from the last parenthesis: the first one after it is field 3 (proc(5)).
fn of_stat(stat: &str, ticks: f64, page: f64, boot: Option<f64>) -> ProcessStats {
    let rest = stat.rsplit_once(')').map_or("", |(_, rest)| rest);
    let fields: Vec<&str> = rest.split_ascii_whitespace().collect();
    let field = |number: usize| -> Option<f64> { fields.get(number.checked_sub(3)?)?.parse().ok() };
    ProcessStats {
        cpu_seconds: field(14).zip(field(15)).map(|(user, system)| (user + system) / ticks),
        threads: field(20),
        start_seconds: field(22).zip(boot).map(|(start, boot)| boot + start / ticks),
        virtual_bytes: field(23),
        resident_bytes: field(24).map(|pages| pages * page),
        ..ProcessStats::default()
    }
}

/// Unix time of the boot, from /proc/stat.
fn boot_time(stat: &str) -> Option<f64> {
    let line = stat.lines().find_map(|line| line.strip_prefix("btime "))?;
    line.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_counted_behind_the_name() {
        let stat = "7 (a) b) S 1 7 7 0 -1 4194304 150 0 0 0 250 50 0 0 20 0 9 0 1000 8192000 300 18446744073709551615";
        let figures = of_stat(stat, 100.0, 4096.0, boot_time("cpu 1 2\nbtime 1700000000\n"));
        assert_eq!(figures.cpu_seconds, Some(3.0));
        assert_eq!(figures.threads, Some(9.0));
        assert_eq!(figures.start_seconds, Some(1_700_000_010.0));
        assert_eq!(figures.virtual_bytes, Some(8_192_000.0));
        assert_eq!(figures.resident_bytes, Some(300.0 * 4096.0));
        assert_eq!(of_stat("", 100.0, 4096.0, None), ProcessStats::default());
    }

    #[test]
    fn statistics_of_this_process() {
        let figures = read();
        assert!(figures.cpu_seconds.is_some() && figures.start_seconds.is_some());
        assert!(figures.resident_bytes.is_some_and(|b| b > 0.0));
        assert!(figures.open_fds.is_some_and(|n| n >= 3.0));
        assert!(figures.threads.is_some_and(|n| n >= 1.0));
    }
}
